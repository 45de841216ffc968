"""The cued maze: what is predicted, the arms, what they come to, and figures."""

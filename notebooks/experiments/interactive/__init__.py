"""Interactive figures: what their scripts in book/extra/ show, from rows and policies."""

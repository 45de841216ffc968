"""What the background needs: causal models, predictors that are to be invariant, small games."""

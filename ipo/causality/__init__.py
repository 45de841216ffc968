"""The background: where invariance comes from, and what the game does in principle.

scm           structural causal models: domains are interventions
regressions   the smallest problems in which domains disagree
predictors    ERM, IRMv1, V-REx and IRM-Games for linear predictors
icp           invariant causal prediction
small_games   the game between players with two weights, and its equilibria
"""

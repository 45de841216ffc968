"""Baselines that the paper names and does not run: regularisers, V-REx and IRMv1.

networks    PPO with weight decay, dropout and penalties on what differs between domains
linear      the same for gradient descent in LQR
trials      their arms, how weights are chosen, and the tables of the chapters
"""

"""Reproduction of the paper's figures and claims: the points that each needs, beside the published ones."""

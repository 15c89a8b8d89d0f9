"""The paper's figures and claims, run again: which points each needs, how ours compare with the published ones."""

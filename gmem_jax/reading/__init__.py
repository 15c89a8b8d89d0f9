"""Readers of binary words from recalls: the paper's net, and others."""

"""Who reads binary words from a recall: the paper's net, and other readers."""

"""How densely states lie: exact nearest neighbours, entropy estimates, histograms."""

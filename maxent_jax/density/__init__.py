"""Density of states: exact nearest neighbours, entropy estimates, histograms."""

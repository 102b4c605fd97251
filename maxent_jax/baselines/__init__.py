"""Baselines as their authors published them: MEPOL, and MaxEnt-H of Hazan et al. (2019)."""

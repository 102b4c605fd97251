"""What the field compares with, as its authors published it: MEPOL, and Hazan et al. (2019)."""

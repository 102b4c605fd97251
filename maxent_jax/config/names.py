"""The names that settings can take, except those in the registry. Loads no array library."""

from maxent_jax.config import registry

REWARDS = ("log1p", "linear", "log", "paper")
ETA = 0.1  # of geometric weights
INPUTS = ("state", "heading")
SPACES = ("features", "position")
REPLAY_DTYPES = ("float32", "float16")
MIXINGS = ("episode", "step")
WEIGHTS = ("method", *registry.WEIGHTS)
REFERENCES = ("method", *registry.REFERENCES)
STARTS = ("method", *registry.STARTS)
# What a run can take from the run that it starts from. With these, the policies of that run play
# the first episodes.
PLAYING = ("best", "mixture", "both")
FILLING = ("mixture", "both")  # with these the episodes fill the replay
WITH_ITS_AGENT = ("last", "best", "both")
STARTED_FROM = ("scratch", "last", *PLAYING)

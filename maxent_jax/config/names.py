"""The names that settings can take, except those in the registry. Loads no array library."""

from maxent_jax.config import registry

REWARDS = ("log1p", "linear", "log", "paper")
INPUTS = ("state", "heading")
SPACES = ("features", "position")
REPLAY_DTYPES = ("float32", "float16")
MIXINGS = ("episode", "step")
WEIGHTS = ("method", *registry.WEIGHTS)
REFERENCES = ("method", *registry.REFERENCES)
STARTS = ("method", *registry.STARTS)
PLAYING = ("best", "mixture", "both")  # what plays first episodes
STARTED_FROM = ("scratch", "last", *PLAYING)

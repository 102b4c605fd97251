"""MEPOL's settings, in addition to a Config."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of MEPOL, frozen and hashable; the defaults are those of the official scripts.

    Raises:
      ValueError: a number is not positive or not finite (initial_log_std may be any number).
    """

    num_episodes: int = 20
    """E: episodes in a batch, each of at most the config's episode_length."""
    num_epochs: int = 1
    """Batches in an iteration."""
    num_neighbors: int = 4
    """k; 50 in the official grid world."""
    kl_threshold: float = 15.0
    """δ, nats: largest KL from the batch's states; 0.05 for the official Ant in x and y."""
    max_updates: int = 30
    """Largest number of gradient steps on a batch; 20 where an official script does not say."""
    max_backtracks: int = 10
    """Refused steps after which a batch ends."""
    backtrack_factor: float = 2.0
    """Each refusal divides the next step by this factor."""
    learning_rate: float = 1e-4
    """Of Adam, as in the official mountain car; the other official runs have 1e-5."""
    hidden_layers: int = 2
    """Hidden layers of the policy."""
    hidden_size: int = 300
    """Units in each; with MuJoCo the official policy has 400 in the first."""
    initial_log_std: float = -0.5
    """Of actions before they are clipped to [-1, 1]; learned, the same in all states."""

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if name != "initial_log_std" and not 0 < value < float("inf"):
                raise ValueError(f"{name} is {value}, but must be a positive number")

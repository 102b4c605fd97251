"""What MEPOL needs to know beside a Config."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of MEPOL; frozen and hashable. The defaults are those of the official
    scripts.

    Raises:
      ValueError: a number that no run can have.
    """

    num_episodes: int = 20
    """E: episodes in a batch, each of the config's episode_length at most."""
    num_epochs: int = 1
    """Batches in an iteration."""
    num_neighbors: int = 4
    """k; 50 in the official grid world."""
    kl_threshold: float = 15.0
    """δ, nats: what the states of a policy may differ by from those of the one that played; 0.05
    for the official Ant in x and y."""
    max_updates: int = 30
    """Steps on a batch; 20 where a script does not say."""
    max_backtracks: int = 10
    """Steps that may be refused before a batch is done with."""
    backtrack_factor: float = 2.0
    """What each refusal divides the next step by."""
    learning_rate: float = 1e-4
    """Adam. That of the official mountain car; the other official runs have 1e-5."""
    hidden_layers: int = 2
    """Hidden layers of the policy."""
    hidden_size: int = 300
    """Units in each; with MuJoCo the official policy has 400 in the first."""
    initial_log_std: float = -0.5
    """Of the actions before they are clipped to [-1, 1]; learned, the same in all states."""

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if name != "initial_log_std" and not 0 < value < float("inf"):
                raise ValueError(f"{name} is {value}, but must be a positive number")

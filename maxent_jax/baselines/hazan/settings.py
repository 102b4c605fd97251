"""The official settings of the two environments, as data."""

from typing import NamedTuple

import numpy as np

from maxent_jax.envs import mountain_car


class Settings(NamedTuple):
    """Settings of a run; `_replace` the numbers for a smaller run."""

    env: str
    num_rounds: int  # P: policies; the first is untrained
    num_episodes: int  # of training for each of the other policies, with one gradient step each
    train_steps: int  # in an episode of training
    rest: tuple[float, float]  # physics state at the bottom
    reset_low: tuple[float, float]  # physics state after a plain reset, uniform
    reset_high: tuple[float, float]
    action_scale: float  # share of the environment's torque or engine that an action uses
    stop_probability: float  # that the start of the next runs loses its velocity
    horizon: int = 200  # T: steps of a run
    num_runs: int = 10  # of the mixture; their visits define the reward
    num_fresh: int = 100  # further runs from rest, for measurement alone
    hidden_size: int = 128
    learning_rate: float = 1e-3
    discount: float = 0.99
    smoothing: float = 132**-0.5  # σ


SETTINGS = {
    "pendulum": Settings(
        env="pendulum",
        num_rounds=15,
        num_episodes=200,
        train_steps=200,
        rest=(np.pi, 0.0),
        reset_low=(-np.pi, -1.0),
        reset_high=(np.pi, 1.0),
        action_scale=0.5,  # 1 N m of 2
        stop_probability=0.3,
    ),
    "mountain_car": Settings(
        env="mountain_car",
        num_rounds=30,
        num_episodes=300,
        train_steps=400,
        rest=(-0.5, 0.0),
        reset_low=(mountain_car.START[0], 0.0),
        reset_high=(mountain_car.START[1], 0.0),
        action_scale=1.0,
        stop_probability=0.0,
    ),
}


def check(settings: Settings) -> None:
    """Checks the settings.

    Raises:
      ValueError: the environment is unknown, or a size is too small.
    """
    if settings.env not in SETTINGS:
        raise ValueError(f"unknown env '{settings.env}': choose from {', '.join(SETTINGS)}")
    least = dict.fromkeys(("num_rounds", "horizon", "num_runs", "num_fresh", "hidden_size"), 1)
    least |= {"num_episodes": 0, "train_steps": 2}  # the return of one step has no deviation
    for name, smallest in least.items():
        if getattr(settings, name) < smallest:
            raise ValueError(
                f"{name} is {getattr(settings, name)}, but must be at least {smallest}"
            )

"""Makes the feature table of an environment: kept coordinates, and projections of the rest.

Projections are divided by their largest magnitude over 10,000 steps of a uniformly random policy,
on C MuJoCo with Gymnasium's options, so the space in which densities are measured depends on no
backend and on no run. The classic environments keep all their few coordinates.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

from maxent_jax import envs, features
from maxent_jax.envs import base

NUM_ENVS, VECTOR_STEPS, SEED = 10, 1000, 0
# The coordinates kept from the state: name, and the value that counts as 1.
KEPT = {
    "ant": {"x": 1.0, "y": 1.0},
    "walker2d": {"x": 1.0, "z": 1.0},
    "humanoid": {"x": 1.0, "y": 1.0},
    "pendulum": {"cos": 1.0, "sin": 1.0, "velocity": 8.0},
    "mountain_car": {"position": 0.9, "velocity": 0.07},
}


def measure(name: str) -> dict:
    """Returns the table as JSON-ready data."""
    env = envs.make(name)
    kept = list(range(len(KEPT[name])))  # the first coordinates of the state
    if len(kept) == env.observation_size:
        scaled, names = np.empty((0, 0)), []
    else:
        projection = features.raw_projection(env.observation_size - len(kept))
        largest = np.abs(np.delete(_random_states(name), kept, axis=1) @ projection).max(axis=0)
        scaled = (projection / largest).round(8)
        names = [f"projection_{i}" for i in range(projection.shape[1])]
    return {
        "env": name,
        "coordinates": kept,
        "units": list(KEPT[name].values()),
        "names": [*KEPT[name], *names],
        "projection": scaled.tolist(),
    }


def _random_states(name: str) -> np.ndarray:
    """States [10,000, D] of a random policy, float64."""
    env = envs.make(name, backend="mujoco")
    key_init, key_steps = jax.random.split(jax.random.key(SEED))
    episodes = base.init(env, NUM_ENVS, 1000, key_init)

    def step(episodes, key):
        key_act, key_env = jax.random.split(key)
        action = jax.random.uniform(key_act, (NUM_ENVS, env.action_size), minval=-1, maxval=1)
        episodes, transition = base.step(env, episodes, action, 1000, key_env)
        return episodes, transition.next_observation

    _, states = jax.lax.scan(step, episodes, jax.random.split(key_steps, VECTOR_STEPS))
    return np.asarray(states, np.float64).reshape(-1, env.observation_size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", choices=sorted(KEPT), required=True)
    name = parser.parse_args().env
    path = Path(envs.__file__).parent / "tables" / f"features_{name}.json"
    path.write_text(json.dumps(measure(name), indent=1) + "\n", encoding="utf-8")
    print(f"wrote {path.name}")


if __name__ == "__main__":
    main()

"""Makes the feature table of an environment: projections divided by their largest magnitude.

The magnitudes come from 10,000 steps of a uniformly random policy on C MuJoCo with Gymnasium's
options, so that no backend and no run changes the space in which densities are measured.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

import maxent_jax
from maxent_jax import envs, features
from maxent_jax.envs import base

NUM_ENVS, VECTOR_STEPS, SEED = 10, 1000, 0
COORDINATES = {"ant": ("x", "y")}


def measure(name: str) -> dict:
    """The table as JSON-ready data."""
    env = envs.make(name, backend="mujoco")
    key_init, key_steps = jax.random.split(jax.random.key(SEED))
    episodes = base.init(env, NUM_ENVS, 1000, key_init)

    def step(episodes, key):
        key_act, key_env = jax.random.split(key)
        action = jax.random.uniform(key_act, (NUM_ENVS, env.action_size), minval=-1, maxval=1)
        episodes, transition = base.step(env, episodes, action, 1000, key_env)
        return episodes, transition.next_observation

    _, states = jax.lax.scan(step, episodes, jax.random.split(key_steps, VECTOR_STEPS))
    flat = np.asarray(states, np.float64).reshape(-1, env.observation_size)
    kept = list(env.task.grid.coordinates)
    projection = features.raw_projection(env.observation_size)
    largest = np.abs(np.delete(flat, kept, axis=1) @ projection).max(axis=0)
    return {
        "env": name,
        "coordinates": kept,
        "names": [*COORDINATES[name], *(f"projection_{i}" for i in range(projection.shape[1]))],
        "random_steps": len(flat),
        "projection": (projection / largest).round(8).tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", choices=sorted(COORDINATES), required=True)
    name = parser.parse_args().env
    path = Path(maxent_jax.__file__).parent / "tables" / f"features_{name}.json"
    path.write_text(json.dumps(measure(name), indent=1) + "\n")
    print(f"wrote {path.name}")


if __name__ == "__main__":
    main()

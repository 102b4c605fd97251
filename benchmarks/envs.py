"""How many env steps per second do the physics backends make, compared with other libraries?

Actions are random. Our backends and bare `mujoco.rollout` start from the same states on the ground
and take the same actions without resets. So each rate comes with the distance of its motion from
that of C MuJoCo: a solver that stops early is faster, but is not the same environment. Gymnasium
and EnvPool reset robots that fall, and robots that lie cost more than robots that stand. Compare
them with our row `episodes`, which also resets.
"""

import functools
import sys
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from benchmarks import common
from maxent_jax import envs
from maxent_jax.analysis.gymnasium_play import IDS
from maxent_jax.config import Config
from maxent_jax.config.registry import PHYSICS
from maxent_jax.envs import base, physics
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.runs import runtime

# Random actions before a workload starts: then an ant has landed, and the others still stand.
SETTLE_STEPS = {"ant": 40, "walker2d": 5, "humanoid": 5}
MIN_STEPS = DRIFT_STEPS = 50  # of each env
MUJOCO_STEPS = 6400  # of all envs together, at least; C MuJoCo is too fast to time fewer
SEED = 0


class Workload(NamedTuple):
    """The same for every implementation; peers that make their own states take only the actions."""

    env: MujocoEnv
    starts: Any  # env states, [N, ...]
    actions: np.ndarray  # [T, N, A] float32 in [-1, 1]

    @property
    def num_steps(self) -> int:
        """Env steps of all envs together."""
        return self.actions.shape[0] * self.actions.shape[1]


class Measurement(NamedTuple):
    """The measurement of one workload."""

    steps_per_second: float
    positions: np.ndarray | None  # [T, N, nq] after each control step, if states can be set
    extra: dict[str, float]  # further columns


def make_workload(name: str, backend: str, profile: str, num_envs: int, num_steps: int) -> Workload:
    """Makes an environment, and the states and actions for all implementations."""
    ground = MujocoEnv(envs.TASKS[name], "mujoco")
    starts, actions = settled(ground, num_envs, num_steps, SEED)
    return Workload(MujocoEnv(envs.TASKS[name], backend, profile), starts, actions)


def settled(env: MujocoEnv, num_envs: int, num_steps: int, seed: int) -> tuple[Any, np.ndarray]:
    """Returns states [N, ...] after some random actions, and further actions [T, N, A]."""
    random = np.random.default_rng(seed)
    settle = SETTLE_STEPS[env.task.name]
    shape = (settle + num_steps, num_envs, env.action_size)
    actions = random.uniform(-1, 1, shape).astype(np.float32)
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), num_envs))
    starts, _ = jax.jit(functools.partial(scan, env))(starts, actions[:settle])
    return starts, actions[settle:]


def scan(env: MujocoEnv, starts: Any, actions: jax.Array) -> tuple[Any, jax.Array]:
    """Returns the last states, and the observations [T, N, D] after each step."""

    def step(state, action):
        state = jax.vmap(env.step)(state, action)
        return state, state.obs

    return jax.lax.scan(step, starts, actions)


def begin_episodes(
    env: base.Env, num_envs: int, num_steps: int, key: jax.Array
) -> tuple[base.Episodes, jax.Array, jax.Array]:
    """Returns N episodes, random actions [T, N, A] and keys [T], the inputs of `step_episodes`."""
    key_init, key_act, key_step = jax.random.split(key, 3)
    shape = (num_steps, num_envs, env.action_size)
    return (
        base.init(env, num_envs, Config.environment.num_starts, key_init),
        jax.random.uniform(key_act, shape, minval=-1, maxval=1),
        jax.random.split(key_step, num_steps),
    )


def step_episodes(
    env: base.Env, episodes: base.Episodes, actions: jax.Array, keys: jax.Array
) -> base.Episodes:
    """Returns the episodes after T steps as in training: those that end begin again."""

    def step(episodes, inputs):
        action, key = inputs
        return base.step(env, episodes, action, Config.environment.episode_length, key)[0], None

    return jax.lax.scan(step, episodes, (actions, keys))[0]


def ours(workload: Workload, repeats: int) -> Measurement:
    inputs = workload.starts, jnp.asarray(workload.actions)
    program, compile_seconds = common.compiled(functools.partial(scan, workload.env), *inputs)
    seconds = common.median_seconds(lambda: program(*inputs), repeats)
    positions = np.asarray(program(*inputs)[1])[..., : workload.env.model.nq]
    extra = {"compile_seconds": compile_seconds}
    return Measurement(workload.num_steps / seconds, positions, extra)


def with_episodes(workload: Workload, repeats: int) -> Measurement:
    """Measures ours as in training, with episodes that end."""
    num_steps, num_envs, _ = workload.actions.shape
    begin = jax.jit(functools.partial(begin_episodes, workload.env, num_envs, num_steps))
    episodes, _, keys = begin(jax.random.key(SEED))
    inputs = episodes, jnp.asarray(workload.actions), keys
    program, _ = common.compiled(functools.partial(step_episodes, workload.env), *inputs)
    seconds = common.median_seconds(lambda: program(*inputs), repeats)
    return Measurement(workload.num_steps / seconds, None, {})


def bare_rollout(workload: Workload, repeats: int) -> Measurement:
    """Measures the upper limit: C MuJoCo on all cores, with all steps known in advance."""
    task = workload.env.task
    model = physics.load_model(task.xml)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    starts = np.zeros((workload.actions.shape[1], mujoco.mj_stateSize(model, full)))
    where_qpos, where_qvel = slice(1, 1 + model.nq), slice(1 + model.nq, 1 + model.nq + model.nv)
    given = jax.tree.map(np.asarray, workload.starts.pipeline_state)
    starts[:, where_qpos], starts[:, where_qvel] = given.qpos, given.qvel  # the time comes first
    warmstart = given.warmstart.astype(np.float64)
    # [N, T × frame skip, A]: each control is held for a control step
    controls = np.repeat(in_control_range(model, workload.actions), task.frame_skip, axis=0)
    controls = np.ascontiguousarray(controls.swapaxes(0, 1), np.float64)
    data = [mujoco.MjData(model) for _ in range(common.CORES)]
    with rollout.Rollout(nthread=common.CORES) as pool:
        run = lambda: pool.rollout(model, data, starts, controls, initial_warmstart=warmstart)[0]
        seconds = common.median_seconds(run, repeats)
        states = run()
    positions = states[:, task.frame_skip - 1 :: task.frame_skip, where_qpos].swapaxes(0, 1)
    return Measurement(workload.num_steps / seconds, positions, {})


def in_control_range(model: mujoco.MjModel, actions: np.ndarray) -> np.ndarray:
    low, high = model.actuator_ctrlrange.T
    return (low + (actions + 1) / 2 * (high - low)).astype(np.float32)


def gymnasium_sync(gymnasium, workload: Workload, repeats: int) -> Measurement:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # v4 is what the paper used
        name = IDS[workload.env.task.name]
        env = gymnasium.make_vec(name, workload.actions.shape[1], vectorization_mode="sync")
    return stepped(env, workload, repeats)


def envpool_threads(envpool, workload: Workload, repeats: int) -> Measurement:
    num_envs = workload.actions.shape[1]
    name = IDS[workload.env.task.name]
    env = envpool.make_gymnasium(name, num_envs=num_envs, num_threads=common.CORES)
    return stepped(env, workload, repeats)


def stepped(env, workload: Workload, repeats: int) -> Measurement:
    """Measures a vector env with Gymnasium's interface, with its own episodes and resets."""
    actions = in_control_range(workload.env.model, workload.actions)
    env.reset()

    def run():
        for action in actions:
            env.step(action)

    rate = workload.num_steps / common.median_seconds(run, repeats)
    env.close()
    return Measurement(rate, None, {})


def brax_on_mjx(brax_envs, workload: Workload, repeats: int) -> Measurement:
    """Measures brax's environment of the same name: another model, with other options."""
    env = brax_envs.get_environment(workload.env.task.name, backend="mjx")
    num_envs = workload.actions.shape[1]
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(SEED), num_envs))
    inputs = starts, jnp.asarray(workload.actions[:MIN_STEPS, :, : env.action_size])
    program, _ = common.compiled(functools.partial(scan, env), *inputs)
    seconds = common.median_seconds(lambda: program(*inputs), repeats)
    return Measurement(inputs[1].shape[0] * num_envs / seconds, None, {})


PEERS = (
    common.Peer("brax", "brax.envs", brax_on_mjx),
    common.Peer("gymnasium", "gymnasium", gymnasium_sync),
    common.Peer("envpool", "envpool", envpool_threads),
)


def fidelity(env: MujocoEnv, found: Measurement, truth: Measurement) -> dict[str, float]:
    """Returns the distance of the motion from that of C MuJoCo, which computes in float64."""
    if found.positions is None or truth.positions is None or found is truth:
        return {}
    departure = found.positions - truth.positions
    num_steps = min(len(departure), DRIFT_STEPS)
    torso = departure[num_steps - 1, :, : 3 if env.task.torso else 2]
    return {
        "largest_error_after_1_step": float(np.max(np.abs(departure[0]))),
        "drift_steps": num_steps,
        "median_drift_metres": float(np.median(np.linalg.norm(torso, axis=-1))),
    }


def measure(cases, peers, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields rows for each case (env, backend, physics, envs, steps), and for peers at its size."""
    ceilings: dict[tuple[str, int, int], Measurement] = {}

    def row(who: str, workload: Workload, found: Measurement, ceiling: Measurement, **more):
        num_steps, num_envs, _ = workload.actions.shape
        return {
            "benchmark": "envs",
            "env": workload.env.task.name,
            "who": who,
            "envs": num_envs,
            "steps_of_each": num_steps,
            "env_steps_per_second": found.steps_per_second,
            "over_bare_rollout": found.steps_per_second / ceiling.steps_per_second,
            **more,
            **fidelity(workload.env, found, ceiling),
            **found.extra,
        }

    for name, backend, profile, num_envs, num_steps in cases:
        workload = make_workload(name, backend, profile, num_envs, num_steps)
        size = name, num_envs, num_steps
        if size not in ceilings:
            ceilings[size] = bare_rollout(workload, repeats)
            yield row("mujoco.rollout", workload, ceilings[size], ceilings[size])
            for peer, module in peers:
                found = common.measured(peer, peer.measure, module, workload, repeats)
                if found is not None:
                    yield row(peer.distribution, workload, found, ceilings[size])
        settings = {"backend": backend, "physics": profile}
        found = ours(workload, repeats)
        yield row("maxent_jax", workload, found, ceilings[size], **settings)
        if backend == "mujoco":
            found = with_episodes(workload, repeats)
            yield row("maxent_jax, episodes", workload, found, ceilings[size], **settings)


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--env", nargs="*", choices=list(IDS), default=list(IDS))
    flags.add_argument("--mujoco-envs", type=int, nargs="*", default=[16, 128, 1024])
    flags.add_argument("--mjx-envs", type=int, nargs="*", default=[64, 256])
    flags.add_argument("--warp-envs", type=int, nargs="*", default=[])
    flags.add_argument("--mjx-physics", nargs="*", choices=PHYSICS, default=list(PHYSICS))
    flags.add_argument(
        "--no-peers", action="store_true", help="no other library than mujoco.rollout"
    )
    args = flags.parse_args()
    runtime.prepare(simulates_in_jax=True)
    common.print_versions(PEERS)
    cases = []
    for name in args.env:
        cases += [
            (name, "mujoco", "reference", n, max(MIN_STEPS, MUJOCO_STEPS // n))
            for n in args.mujoco_envs
        ]
        cases += [(name, "mjx", p, n, MIN_STEPS) for p in args.mjx_physics for n in args.mjx_envs]
        cases += [(name, "warp", "reference", n, MIN_STEPS) for n in args.warp_envs]
    peers = [] if args.no_peers else common.importable(PEERS)
    if args.toy:
        print("toy: without mjx, whose compilation takes tens of seconds", file=sys.stderr)
        cases = [("humanoid", "mujoco", "reference", 4, 4)]
        peers = [(peer, module) for peer, module in peers if peer.module == "gymnasium"]
    for row in measure(cases, peers, args.repeats):
        common.emit(row)


if __name__ == "__main__":
    main()

"""How many SAC updates per second, what share of the matmul peak is that, and how fast are peers?

Updates run in one scan, each on its own batch of Ant's sizes. Peers run their own `train` and draw
the batches from their own replay. The whole loop also steps Ant on C MuJoCo: ours is a segment of
MaxEnt-V with its reward, theirs is `learn`.
"""

import functools
import itertools
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common, seeds
from maxent_jax.config import preset
from maxent_jax.runs import runtime
from maxent_jax.sac import agent, losses

OBSERVATION_SIZE, ACTION_SIZE = 29, 8  # Ant
SIZES = ((128, 128), (256, 256))  # hidden units, batch
NUM_SEEDS = (1, 2)
NUM_HIDDEN_LAYERS = 2
NUM_UPDATES = 200
PEAK_SIZE = 2048
LOOP_STEPS = 640


def peak_flops(size: int, repeats: int) -> float:
    """Measures FLOP/s of a square float32 matmul at the precision of the networks' layers."""
    a = jnp.ones((size, size))
    product, _ = common.compiled(jnp.matmul, a, a)
    return 2 * size**3 / common.median_seconds(lambda: product(a, a), repeats)


def update_flops(hidden_size: int, batch_size: int) -> float:
    """Counts the FLOP of the matmuls that one update needs.

    A layer of m inputs and n outputs costs 2 m n per row forward, as much for the gradient of its
    weights, and as much for the gradient of its inputs, which a first layer does not need. XLA
    counts everything: 5 % more for 128 units and a batch of 128, 3 % more for 256 and 256.
    """

    def forward(num_inputs, num_outputs):
        widths = [num_inputs, *[hidden_size] * NUM_HIDDEN_LAYERS, num_outputs]
        layers = [2 * m * n for m, n in itertools.pairwise(widths)]
        return sum(layers), layers[0]

    actor, actor_first = forward(OBSERVATION_SIZE, 2 * ACTION_SIZE)
    critic, critic_first = forward(OBSERVATION_SIZE + ACTION_SIZE, 1)
    observation_share = OBSERVATION_SIZE / (OBSERVATION_SIZE + ACTION_SIZE)
    target = actor + 2 * critic
    critic_step = 2 * (3 * critic - critic_first)
    # Through both critics to the action, without gradients of weights or observation.
    through_critics = 2 * (2 * critic - critic_first * observation_share)
    actor_step = 3 * actor - actor_first + through_critics
    return float(batch_size * (target + critic_step + actor_step))


def many_updates(
    hidden_size: int, batch_size: int, layer_norm: bool, num_seeds: int, num_updates: int
) -> tuple[Callable, tuple[Any, Any]]:
    """Returns a function that makes `num_updates` updates of each seed, and its arguments."""
    config = preset(
        "paper",
        hidden_layers=NUM_HIDDEN_LAYERS,
        hidden_size=hidden_size,
        batch_size=batch_size,
        critic_layer_norm=layer_norm,
    )
    sac = agent.make(config, OBSERVATION_SIZE, ACTION_SIZE, lambda observation: observation)
    key_init, key_batches, key_updates = jax.random.split(jax.random.key(0), 3)
    lead = (num_seeds, num_updates, batch_size)
    columns = [(OBSERVATION_SIZE,), (ACTION_SIZE,), (), (OBSERVATION_SIZE,), ()]
    keys = jax.random.split(key_batches, len(columns))
    batches = losses.Batch(
        *(
            jax.random.uniform(key, lead + column, minval=-1.0, maxval=1.0)
            for key, column in zip(keys, columns, strict=True)
        )
    )
    learners = jax.jit(jax.vmap(functools.partial(agent.init, sac)))(
        jax.random.split(key_init, num_seeds)
    )
    inputs = batches, jax.random.split(key_updates, lead[:2])

    def run(learner, inputs):
        update = lambda learner, x: (agent.update(sac, learner, *x)[0], None)
        return jax.lax.scan(update, learner, inputs)[0]

    if num_seeds == 1:  # no axis of seeds, as in training
        return run, jax.tree.map(lambda x: x[0], (learners, inputs))
    return jax.vmap(run), (learners, inputs)


def ours(
    hidden_size: int, batch_size: int, layer_norm: bool, num_seeds: int, num_updates: int, repeats
) -> tuple[float, float]:
    """Returns updates per second of all seeds together, and the seconds to compile."""
    run, inputs = many_updates(hidden_size, batch_size, layer_norm, num_seeds, num_updates)
    program, compile_seconds = common.compiled(run, *inputs)
    seconds = common.median_seconds(lambda: program(*inputs), repeats)
    return num_seeds * num_updates / seconds, compile_seconds


class Loop(NamedTuple):
    """The sizes of a whole loop."""

    num_envs: int
    updates_per_step: float


# One environment as in the peers' defaults, several at the same ratio, and quick's own ratio.
_QUICK = preset("quick")
LOOPS = (
    Loop(1, 1.0),
    Loop(_QUICK.budget.num_envs, 1.0),
    Loop(_QUICK.budget.num_envs, _QUICK.budget.updates_per_step),
)


class Noise(gymnasium.Env):
    """Spaces of Ant's sizes, from which a peer makes its networks."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)


def baselines(module, hidden_size: int, batch_size: int, num_updates: int, repeats: int) -> float:
    """Measures updates per second of stable-baselines3, or of sbx, which has the same interface."""
    from stable_baselines3.common import logger

    model = module.SAC(
        "MlpPolicy",
        Noise(),
        batch_size=batch_size,
        buffer_size=10_000,
        policy_kwargs={"net_arch": [hidden_size] * NUM_HIDDEN_LAYERS},
        device="cpu",
    )
    model.set_logger(logger.configure(None, []))
    random = np.random.default_rng(0)
    for _ in range(1000):
        observation, following = random.standard_normal((2, 1, OBSERVATION_SIZE), np.float32)
        action = random.uniform(-1, 1, (1, ACTION_SIZE))
        reward, done = random.standard_normal(1), np.zeros(1)
        model.replay_buffer.add(observation, following, action, reward, done, [{}])
    run = lambda: model.train(gradient_steps=num_updates, batch_size=batch_size)
    return num_updates / common.median_seconds(run, repeats)


def our_loop(hidden_size: int, batch_size: int, loop: Loop, steps: int, repeats: int) -> float:
    """Measures env steps per second of our training on Ant."""
    config = preset(
        "quick",
        hidden_size=hidden_size,
        batch_size=batch_size,
        num_envs=loop.num_envs,
        updates_per_step=loop.updates_per_step,
        steps_per_iteration=steps,
        num_segments=1,
        replay_size=100_000,
        random_baseline=False,
        # as in the peers' networks and targets
        critic_layer_norm=False,
        return_steps=1,
        yaw_copies=0,
    )
    return steps / seeds.seconds_per_segment(config, repeats)


def their_loop(
    module, hidden_size: int, batch_size: int, loop: Loop, steps: int, repeats: int
) -> float:
    """Measures env steps per second of `learn` on as many environments of Gymnasium's Ant."""
    from stable_baselines3.common.env_util import make_vec_env

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium warns that v4 is out of date
        envs = make_vec_env("Ant-v4", n_envs=loop.num_envs)
    model = module.SAC(
        "MlpPolicy",
        envs,
        batch_size=batch_size,
        buffer_size=100_000,
        learning_starts=loop.num_envs,
        train_freq=1,
        gradient_steps=round(loop.updates_per_step * loop.num_envs),
        policy_kwargs={"net_arch": [hidden_size] * NUM_HIDDEN_LAYERS},
        device="cpu",
    )
    model.learn(steps)  # compiles and fills the replay
    run = lambda: model.learn(steps, reset_num_timesteps=False)
    return steps / common.median_seconds(run, repeats)


PEERS = (
    common.Peer("sbx-rl", "sbx", baselines),
    common.Peer("stable-baselines3", "stable_baselines3", baselines),
)


def measure(
    size: tuple[int, int], num_updates: int, peak: float, peers, repeats: int
) -> Iterator[dict[str, Any]]:
    """Yields rows for one size; ratios are to our first row, one seed without layer norm."""
    hidden_size, batch_size = size
    rates: list[float] = []

    def row(who: str, updates: float, **more):
        rates.append(updates)
        return {
            "benchmark": "sac",
            "who": who,
            "hidden_size": hidden_size,
            "batch_size": batch_size,
            "updates_per_second": updates,
            "samples_per_second": updates * batch_size,
            "share_of_matmul_peak": updates * update_flops(hidden_size, batch_size) / peak,
            "ours_over_this": rates[0] / updates,
            **more,
        }

    for layer_norm, num_seeds in itertools.product((False, True), NUM_SEEDS):
        updates, compile_seconds = ours(
            hidden_size, batch_size, layer_norm, num_seeds, num_updates, repeats
        )
        more = {"layer_norm": layer_norm, "seeds": num_seeds, "compile_seconds": compile_seconds}
        yield row("maxent_jax", updates, **more)
    for peer, module in peers:
        args = module, hidden_size, batch_size, num_updates, repeats
        updates = common.measured(peer, peer.measure, *args)
        if updates is not None:
            yield row(peer.distribution, updates, layer_norm=False, seeds=1)


def measure_loops(
    size: tuple[int, int], loops, steps: int, peers, repeats: int
) -> Iterator[dict[str, Any]]:
    """Yields rows for one size; ratios are to ours in the same loop."""
    hidden_size, batch_size = size
    for loop in loops:
        sizes = hidden_size, batch_size, loop, steps, repeats
        ours_here = our_loop(*sizes)

        def row(who: str, rate: float, loop=loop, ours_here=ours_here):
            return {
                "benchmark": "sac",
                "who": f"{who}, whole loop",
                "hidden_size": hidden_size,
                "batch_size": batch_size,
                **loop._asdict(),
                "env_steps_per_second": rate,
                "ours_over_this": ours_here / rate,
            }

        yield row("maxent_jax", ours_here)
        for peer, module in peers:
            rate = common.measured(peer, their_loop, module, *sizes)
            if rate is not None:
                yield row(peer.distribution, rate)


def main() -> None:
    args = common.parser(__doc__).parse_args()
    common.print_versions(PEERS)
    runtime.prepare(simulates_in_jax=False)
    sizes, num_updates = (((16, 8),), 4) if args.toy else (SIZES, NUM_UPDATES)
    loops, steps = ((Loop(4, 0.25),), 8) if args.toy else (LOOPS, LOOP_STEPS)
    peak = peak_flops(256 if args.toy else PEAK_SIZE, args.repeats)
    common.emit({"benchmark": "sac", "who": "matmul", "gflop_per_second": peak / 1e9})
    peers = common.importable(PEERS)
    for size in sizes:
        for row in measure(size, num_updates, peak, peers, args.repeats):
            common.emit(row)
        for row in measure_loops(size, loops, steps, peers, args.repeats):
            common.emit(row)


if __name__ == "__main__":
    main()

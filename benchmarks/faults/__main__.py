"""Does a run survive failures? Prints one row per fault, with the number of trials and the result.

Parts run one after another. Each row is printed as soon as it is known. `--toy` causes each fault
once or a few times.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from benchmarks import common
from benchmarks.faults import api, crowd, damage, disk, environment, inputs, numbers, saves, stops
from maxent_jax.runs import runtime

PARTS = {
    "inputs": inputs,
    "api": api,
    "environment": environment,
    "stops": stops,
    "damage": damage,
    "disk": disk,
    "crowd": crowd,
    "numbers": numbers,
    "saves": saves,
}


def main() -> None:
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--toy", action="store_true", help="cause each fault once or a few times")
    flags.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    args = flags.parse_args()
    common.print_versions()
    runtime.prepare(simulates_in_jax=False)
    passed = True
    for name in args.part:
        with tempfile.TemporaryDirectory() as folder:
            for row in PARTS[name].measure(Path(folder), args.toy):
                common.emit({"benchmark": "faults", "part": name, **row})
                passed &= row["passed"]
    if not passed:
        sys.exit(1)


if __name__ == "__main__":
    main()

"""How fast is everything on a GPU? Two parts of at most five minutes each, most important first.

`--part first`: the device; nearest neighbours; Ant's env steps; MaxEnt-V on Ant, end to end, with
the command `train`. `--part second`: Walker2d and Humanoid; gradient steps of one seed and of eight
in parallel; MJX compared with C MuJoCo; the longest kernels of training; peers. All programs of a
part are compiled at the same time, and compile times are reported separately. A row is appended to
OUT/PART.jsonl as soon as it is measured. When its time is up, a part ends with the rows that it
has. No network is needed.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.gpu.parts import PACKING, PARTS, run_part, summary

SECONDS = 300.0  # of a part


def main() -> None:
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--part", choices=list(PARTS), required=True)
    flags.add_argument("--seconds", type=float, default=SECONDS, help="time limit of the part")
    flags.add_argument(
        "--out", type=Path, default=Path("results/gpu"), help="folder for rows and figures"
    )
    flags.add_argument(
        "--toy", action="store_true", help="check that it runs, with tiny sizes on a CPU"
    )
    args = flags.parse_args()
    if args.seconds <= PACKING:
        flags.error(f"--seconds must be more than {PACKING:.0f}.")
    args.out.mkdir(parents=True, exist_ok=True)
    rows = run_part(args.part, args.seconds, args.toy, args.out)
    print("\n".join(summary(rows)))
    if any(row["section"] == "failed" for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()

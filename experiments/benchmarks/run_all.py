# SPDX-License-Identifier: BSD-3-Clause
"""Every benchmark, one after the other, each in a process of its own.

python -m experiments.benchmarks.run_all
"""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ORDER = ("answer", "checking", "ompl_callbacks", "bake", "predict", "fit", "risk", "mesh_checker")


def main() -> None:
    for name in ORDER:
        print(f"--- experiments/benchmarks/{name}.py", flush=True)
        module = f"experiments.benchmarks.{name}"
        subprocess.run([sys.executable, "-m", module], check=True, cwd=ROOT)


if __name__ == "__main__":
    main()

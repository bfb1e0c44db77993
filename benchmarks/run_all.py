# SPDX-License-Identifier: BSD-3-Clause
"""Every benchmark, one after the other, each in a process of its own.

python benchmarks/run_all.py
"""

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
ORDER = ("checking", "ompl_callbacks", "bake", "predict", "fit", "risk", "mesh_checker")


def main() -> None:
    for name in ORDER:
        print(f"--- benchmarks/{name}.py", flush=True)
        subprocess.run([sys.executable, str(FOLDER / f"{name}.py")], check=True)


if __name__ == "__main__":
    main()

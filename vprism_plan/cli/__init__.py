# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `vprism-plan demo | map | plan | query | mesh | export | robot | view`, ...

Exit codes: 0 done, 1 no safe answer, 2 bad input, 130 interrupted; 3 is a defect of
this program, with a traceback to report.
"""

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from vprism_plan.errors import VPrismError

# The file of each command; there `run_COMMAND(command, console)` returns the exit code.
_FILES = {
    "demo": "_plans", "map": "_maps", "mesh": "_maps", "plan": "_plans", "query": "_inspect",
    "export": "_maps", "view": "_inspect", "robot": "_inspect", "warmup": "_warmup",
}  # fmt: skip
DONE, NO_SAFE_ANSWER, BAD_INPUT, DEFECT, INTERRUPTED = 0, 1, 2, 3, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code. Errors are one line on stderr."""
    from vprism_plan.cli._parsing import UsageError, parse

    try:
        command = parse(sys.argv[1:] if arguments is None else arguments)
        # Two OpenMP runtimes that spin on the same cores cost more than they bring; the
        # kernels have their own thread pool.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        from vprism_plan.cli._console import Console

        console = Console(as_json=command.json, strict=getattr(command, "strict", False))
        file = import_module(f"vprism_plan.cli.{_FILES[command.command]}")
        code: int = getattr(file, f"run_{command.command}")(command, console)
        return code
    except SystemExit:  # --help
        return DONE
    except BrokenPipeError:  # the reader of our output left early
        sys.stderr.close()
        return DONE
    except (UsageError, VPrismError, OSError) as error:
        sys.stderr.write(f"vprism-plan: error: {' '.join(str(error).split())}\n")
        return BAD_INPUT
    except KeyboardInterrupt:
        sys.stderr.write("vprism-plan: interrupted; nothing was left half-written\n")
        return INTERRUPTED
    except Exception:
        import traceback

        traceback.print_exc()
        return DEFECT

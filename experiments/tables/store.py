# SPDX-License-Identifier: BSD-3-Clause
"""Answers of an experiment on disk: one file per case, found again by what was asked."""

import hashlib
import json
import logging
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vprism_plan._files import write_text
from vprism_plan.errors import ConfigError

_log = logging.getLogger(__name__)
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class Case:
    """One thing to compute, and everything the answer depends on.

    Attributes:
        name: what people read in messages and file names; need not be unique.
        asked: JSON values that hold the whole question: seeds, configurations, data, and
            a version number of every piece of code whose meaning may change. Two cases
            that ask the same have the same answer.
        given: what the task needs besides and no answer depends on, and so no part of the
            question: where on this machine the files lie whose digest is asked, say.
    """

    name: str
    asked: dict[str, Any]
    given: dict[str, Any] = field(default_factory=dict)


def require_writable(folder: Path) -> None:
    """Raise ConfigError, hours before the first write would, if a folder cannot be written.

    The folder, or the nearest above it that exists, is tried with a file; nothing remains.
    """
    nearest = Path(folder).absolute()
    try:
        while not nearest.exists() and nearest != nearest.parent:
            nearest = nearest.parent
        with tempfile.TemporaryFile(dir=nearest) as probe:
            probe.write(b"probe")
    except OSError as error:
        raise ConfigError(
            f"{folder} cannot be written ({error.strerror}: {nearest}); give another folder"
        ) from error


class Store:
    """Folder of answers of one task.

    Args:
        folder: made when the first answer is written.
        task: name of what answers, part of every question.
    """

    def __init__(self, folder: Path, task: str) -> None:
        self.folder = Path(folder)
        self.task = task

    def question(self, case: Case) -> dict[str, Any]:
        """Return what identifies a case, as it reads back from JSON.

        Raises:
            ConfigError: the question is not JSON, or holds NaN or an infinity.
        """
        try:
            text = json.dumps({"task": self.task, "asked": case.asked}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"case {case.name!r} asks for {case.asked!r}, which is not JSON ({error}); "
                "use numbers, text, lists and dicts"
            ) from error
        question: dict[str, Any] = json.loads(text)
        return question

    def path(self, case: Case) -> Path:
        """Return where the answer to a case belongs."""
        text = json.dumps(self.question(case), sort_keys=True, separators=(",", ":"))
        digest = hashlib.sha256(text.encode()).hexdigest()[:20]
        readable = "".join(c if c.isalnum() or c in "-_" else "-" for c in case.name)[:80]
        return self.folder / f"{readable}-{digest}.json"

    def read(self, case: Case) -> dict[str, Any] | None:
        """Return the stored answer; None if there is none, or (logged) not a usable one."""
        path = self.path(case)
        if not path.is_file():
            return None
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            usable = (
                found["format"] == _FORMAT
                and found["question"] == self.question(case)
                and isinstance(found["answer"], dict)
            )
        except (ValueError, KeyError, TypeError) as error:
            _log.warning("%s is not a whole answer (%r) and is computed again", path, error)
            return None
        if not usable:
            _log.warning("%s answers something else than %s; computed again", path, case.name)
            return None
        answer: dict[str, Any] = found["answer"]
        return answer

    def write(self, case: Case, answer: dict[str, Any]) -> dict[str, Any]:
        """Keep an answer, whole or not at all; return it as it reads back.

        Raises:
            TypeError, ValueError: the answer is not a dict of JSON values.
        """
        if not isinstance(answer, dict):
            raise TypeError(f"case {case.name!r} was answered by {type(answer)}, not a dict")
        text = json.dumps({"format": _FORMAT, "question": self.question(case), "answer": answer})
        write_text(self.path(case), text + "\n")
        kept: dict[str, Any] = json.loads(text)["answer"]
        return kept

"""The growing files of a run: what they are up to now is recorded in every checkpoint, so that damage is seen later."""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path

from saclab.records import COUNTERS, EPISODES, Q_BIAS, FileRecord, read_bytes, require_recorded

LOGS = ("metrics.jsonl", "episodes.csv", "evaluations.csv", "q_bias.csv")
OF_TERMS = "reward_terms.csv"
"""The log of a run beside them whose reward is split into terms."""
REMAINDER = "remainder"
"""What the named terms leave of the reward."""
EPISODE_COLUMNS = tuple(EPISODES)
Q_BIAS_COLUMNS = tuple(Q_BIAS)


def evaluation_columns(episodes: int) -> tuple[str, ...]:
    """`seconds` is wall-clock time, here as in every log: the only entry that differs between equal runs."""
    returns = [f"return_{index}" for index in range(episodes)]
    lengths = [f"length_{index}" for index in range(episodes)]
    return (*COUNTERS, "mean_return", *returns, *lengths, "seconds")


def reward_term_columns(terms: Sequence[str]) -> tuple[str, ...]:
    """return_<term> of each term and of the remainder, then weight_<term> of each, which counts from then on."""
    plain = plain_words(terms)
    returns = [f"return_{word}" for word in (*plain, REMAINDER)]
    weights = [f"weight_{word}" for word in plain]
    return (*COUNTERS, *returns, *weights, "seconds")


def plain_words(terms: Sequence[str]) -> list[str]:
    """What stands for each term in the columns of a log: its name, or its number, from 0, where that is no word."""

    def is_plain(term: str) -> bool:
        return bool(re.fullmatch(r"(?!\d+$)[A-Za-z0-9_.-]+", term)) and term != REMAINDER

    return [term if is_plain(term) else str(number) for number, term in enumerate(terms)]


class Logs:
    """The growing files of a run; what they are up to now is part of a checkpoint."""

    def __init__(
        self,
        run: Path,
        evaluation_episodes: int,
        recorded: Mapping[str, FileRecord] | None,
        reward_terms: Sequence[str] = (),
    ) -> None:
        """Open for appending, cut back to what was `recorded`, or start anew with header lines if nothing was.

        Raises:
            Damaged: if one does not begin with what was recorded of it.
        """
        headers = {
            "episodes.csv": ",".join(EPISODE_COLUMNS) + "\n",
            "evaluations.csv": ",".join(evaluation_columns(evaluation_episodes)) + "\n",
            "metrics.jsonl": "",
            "q_bias.csv": ",".join(Q_BIAS_COLUMNS) + "\n",
        }
        if reward_terms:
            headers[OF_TERMS] = ",".join(reward_term_columns(reward_terms)) + "\n"
        beginnings = {name: recorded_beginning(run / name, (recorded or {}).get(name)) for name in headers}
        self.files, self.written = {}, {}
        for name, beginning in beginnings.items():
            file = (run / name).open("r+" if (run / name).exists() else "w+", newline="")
            file.truncate(len(beginning))
            file.seek(len(beginning))
            if not beginning:
                file.write(headers[name])
                file.flush()
            self.files[name] = file
            self.written[name] = len(beginning), sha256(beginning)

    def episode(self, *row: object) -> None:
        csv.writer(self.files["episodes.csv"], lineterminator="\n").writerow(row)

    def evaluation(self, *row: object) -> None:
        csv.writer(self.files["evaluations.csv"], lineterminator="\n").writerow(row)
        self.flush()

    def q_bias(self, *row: object) -> None:
        csv.writer(self.files["q_bias.csv"], lineterminator="\n").writerow(row)

    def reward_terms(self, *row: object) -> None:
        csv.writer(self.files[OF_TERMS], lineterminator="\n").writerow(row)

    def metrics(self, values: dict[str, float | int]) -> None:
        self.files["metrics.jsonl"].write(json.dumps(values, allow_nan=False) + "\n")
        self.flush()

    def flush(self) -> None:
        for file in self.files.values():
            file.flush()

    def records(self) -> dict[str, FileRecord]:
        """What each log is, once everything is on its way to the disk."""
        self.flush()
        for name, file in self.files.items():
            os.fsync(file.fileno())
            length, checksum = self.written[name]
            end = os.fstat(file.fileno()).st_size
            checksum.update(os.pread(file.fileno(), end - length, length))
            self.written[name] = end, checksum
        return {name: FileRecord(length, checksum.hexdigest()) for name, (length, checksum) in self.written.items()}

    def close(self) -> None:
        for file in self.files.values():
            file.close()


def recorded_beginning(path: Path, recorded: FileRecord | None) -> bytes:
    """The part of a log that belongs to a checkpoint; raises Damaged if it is not what was recorded."""
    if recorded is None or recorded.bytes == 0:
        return b""
    content = read_bytes(path)
    require_recorded(path, content, recorded, grows=True)
    return content[: recorded.bytes]

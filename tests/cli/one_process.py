"""One command after the other in one process, so that what is slow to import is imported once.

A program of its own: each command is a line of JSON, and so is its answer. With CONFINED it gives up the rights of root
to read and write what the permissions of files forbid, which nothing that it starts gets back.
"""

from __future__ import annotations

import ctypes
import io
import json
import os
import sys
import tempfile
import traceback
from contextlib import redirect_stderr, redirect_stdout

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2  # of Linux's headers
CONFINED, AGAIN = "confined", "again"


def give_up_rights() -> None:
    """What root may do is taken from the bounding set when a program starts: so this one starts itself anew."""
    if os.geteuid() == 0 and sys.argv[1:] == [CONFINED]:
        for right in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, right, 0, 0, 0)
        os.execv(sys.executable, [sys.executable, __file__, CONFINED, AGAIN])


def bound_by_permissions() -> bool:
    """Whether a file that nobody may read cannot be read."""
    with tempfile.NamedTemporaryFile() as file:
        os.chmod(file.name, 0)
        return not os.access(file.name, os.R_OK, effective_ids=os.access in os.supports_effective_ids)


def answers(folder: str, arguments: list[str]) -> dict[str, object]:
    """Exit status and output of a command in a folder."""
    from saclab.cli.main import main

    os.chdir(folder)
    output, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(output), redirect_stderr(errors):
        try:
            status = main(arguments)
        except BaseException:
            traceback.print_exc()
            status = -1
    return {"status": status, "output": output.getvalue(), "errors": errors.getvalue()}


if __name__ == "__main__":
    give_up_rights()
    told = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    print(json.dumps(bound_by_permissions()), file=told, flush=True)
    for line in sys.stdin:
        print(json.dumps(answers(*json.loads(line))), file=told, flush=True)

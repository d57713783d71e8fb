"""Commands without the rights of root, for tests that run as root; each is a line of JSON, and so is its answer.

A program of its own: it gives up the rights to read and write what the permissions of files forbid, which nothing that
it starts gets back, and then runs one command after the other, so that what is slow to import is imported once.
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
AGAIN = "confined"


def give_up_rights() -> None:
    """What root may do is taken from the bounding set when a program starts: so this one starts itself anew."""
    if os.geteuid() == 0 and AGAIN not in sys.argv:
        for right in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, right, 0, 0, 0)
        os.execv(sys.executable, [sys.executable, __file__, AGAIN])


def bound_by_permissions() -> bool:
    """Whether a file that nobody may read cannot be read."""
    with tempfile.NamedTemporaryFile() as file:
        os.chmod(file.name, 0)
        return not os.access(file.name, os.R_OK, effective_ids=os.access in os.supports_effective_ids)


def answers(arguments: list[str]) -> dict[str, object]:
    """Exit status and output of a command."""
    from saclab.cli.main import main

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
        print(json.dumps(answers(json.loads(line))), file=told, flush=True)

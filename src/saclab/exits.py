"""How a command or a worker process ends after an exception: its exit status, and one line for the user."""

from __future__ import annotations

import signal

from saclab.errors import NonFiniteError, TrainingFailed, UserError
from saclab.signals import EXIT_STATUS

EXIT_FAILED = 1
EXIT_USER_ERROR = 2


def end_after(error: BaseException) -> tuple[int, str]:
    """Exit status and line; an error that only a mistake in saclab explains is raised again, with its traceback.

    Args:
        error: whatever has ended the work.
    """
    match error:
        case UserError() | NonFiniteError():
            return EXIT_USER_ERROR, str(error)
        case TrainingFailed():
            return EXIT_FAILED, str(error)
        case KeyboardInterrupt():  # outside training, where there is nothing to save
            return EXIT_STATUS[signal.SIGINT], "interrupted"
        case MemoryError():
            return EXIT_FAILED, no_memory(error)
        case RecursionError():
            return EXIT_FAILED, f"nested too deeply: {error}; what was saved is kept"
        case OSError():
            return EXIT_FAILED, f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}"
        case RuntimeError() if "RESOURCE_EXHAUSTED" in str(error):  # XLA's way to say it
            return EXIT_FAILED, no_memory(error)
    raise error


def no_memory(error: BaseException) -> str:
    said = str(error).partition("\n")[0]
    return (
        f"out of memory{f' ({said})' if said else ''}; what was saved is kept: use smaller networks, batches or replay "
        "buffers, or fewer runs at once"
    )

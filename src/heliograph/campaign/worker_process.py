"""Worker process: it reads a campaign and then jobs from its standard input, a line each, and answers in lines.

It is a program of its own instead of multiprocessing: nothing is forked while JAX runs, and the script that called the
library is not run again.
"""

import json
import os
import signal
from dataclasses import asdict


def main() -> None:
    """Serve until the input ends, as it does when the parent dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    # Answers go to a copy of stdout, jobs come from a copy of stdin; a user's module gets neither.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a user's module prints must not be taken for an answer
    requested = os.fdopen(os.dup(0), encoding="utf-8")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)  # nor may it read a job: it finds the end of its input
    os.close(nothing)
    from heliograph.campaign.jobs import perform_job

    # One answer for each job, in order.
    campaign, store = json.loads(requested.readline())
    for line in requested:
        answer = json.dumps(asdict(perform_job(campaign, store, *json.loads(line))))
        try:
            print(answer, file=answers, flush=True)
        except BrokenPipeError:
            os._exit(1)  # the parent is dead: nobody wants an answer, nor a word of complaint


if __name__ == "__main__":
    main()

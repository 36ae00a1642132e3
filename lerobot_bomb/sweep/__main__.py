"""A worker's process: `python -m lerobot_bomb.sweep FOLDER PART RUN FILE_DESCRIPTOR`.

It ends when its standard input does. Its parent holds that, so it ends however the parent ended.
"""

import os
import sys
import threading


def _end_with_parent() -> None:
    while os.read(sys.stdin.fileno(), 1):  # sys.stdin.read() would hold a lock that Python's end needs
        pass
    os._exit(1)


if __name__ == "__main__":
    # before LeRobot is imported: workers of a killed command would first spend half a minute on that
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from lerobot_bomb.sweep.worker import run_worker

    run_worker(*sys.argv[1:])

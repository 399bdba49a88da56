"""A clock for what measures time, so that no test depends on how long anything takes."""

import threading


class Clock:
    """Stand in for the module `time`: time passes where somebody sleeps, and by `tick` where somebody looks.

    `slept` holds how long each sleep was [s]. Threads may sleep beside each other: what each sleeps is added up.
    """

    def __init__(self, *, tick: float = 0.0) -> None:
        self.now, self.tick = 0.0, tick
        self.slept: list[float] = []
        self._lock = threading.Lock()

    def perf_counter(self) -> float:
        with self._lock:
            self.now += self.tick
            return self.now

    monotonic = process_time = perf_counter

    def sleep(self, seconds: float) -> None:
        with self._lock:
            self.slept.append(seconds)
            self.now += seconds

"""A clock for what measures time, so that no test depends on how long anything takes."""


class Clock:
    """Stand in for the module `time`: time passes where somebody sleeps, and by `tick` where somebody looks.

    `slept` holds how long each sleep was [s].
    """

    def __init__(self, *, tick: float = 0.0) -> None:
        self.now, self.tick = 0.0, tick
        self.slept: list[float] = []

    def perf_counter(self) -> float:
        self.now += self.tick
        return self.now

    monotonic = process_time = perf_counter

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds

"""The option that every simulated scene has."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class EpisodeOptions:
    """`horizon`: how long an episode lasts, as a multiple of the scene's own duration.

    Steps and controls stay what they are and when they are. A shorter episode ends earlier, so that controls it does
    not reach have no effect and no gradient; in a longer one tools, pan, cart and joints rest after the last control,
    and bodies go on. The loss is that of the state at the episode's end, or of the steps there are; targets that a
    demonstration makes stay those of horizon 1.
    """

    horizon: float = dataclasses.field(default=1.0, kw_only=True, metadata={"most": 8.0})

    def count_steps(self, steps: int) -> int:
        """Return how many steps an episode has where the scene's own duration takes so many."""
        return max(1, round(self.horizon * steps))

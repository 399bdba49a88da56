"""Rerun recordings as files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from ...storage.files import replacing


@contextmanager
def recording(name: str, path: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """Give a stream to log to, and write the recording, with the view it opens in, to `path` at the end.

    `name` is that of the application too, since a viewer keeps one blueprint for each. No clock is recorded, and none
    says what is put together into a chunk, so that equal logs give equal recordings. It is gathered in memory: on a
    full disk rerun's own files end in the middle without an error, and their closing waits for ever.
    """
    stream = rr.RecordingStream(
        f"gradscape-{name}", recording_id=name, send_properties=False, batcher_config=rr.ChunkBatcherConfig.NEVER()
    )
    stream.set_log_time_enabled(False)
    kept = stream.memory_recording()
    stream.send_blueprint(blueprint, make_active=False)
    yield stream
    with replacing(path) as partial:
        partial.write_bytes(kept.drain_as_bytes())

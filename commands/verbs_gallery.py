"""Verbs of the gallery: make what its figures lack, list them, build and serve the site."""

from __future__ import annotations

from typing import Annotated

import typer

from .arguments import Data, Device, Fidelity, Json, Scheduler


def compute(
    only: Annotated[
        list[str] | None, typer.Option(help="A figure's id or an environment; may be repeated. By default all.")
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="slices, sweeps, episodes, searches, reports or tradeoffs; may be repeated. By default all of them."
        ),
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    resolution: Annotated[int | None, typer.Option(min=2, help="Points along each axis, for all figures.")] = None,
    scheduler: Scheduler = None,
    data: Data = None,
) -> None:
    """Make what is missing of the figures: an estimate first, then one after the other.

    Slices have the figures' fidelity, and so have episodes at some of their nodes; sweeps and searches are drafts.

    Stop it at any moment: the same command goes on where it stopped. A figure that fails does not stop the others.
    """
    from .gallery_report import compute as compute_gallery

    compute_gallery(
        only=only or [],
        parts=part or [],
        fidelity=fidelity,
        device=device,
        resolution=resolution,
        data=data,
        scheduler=scheduler,
    )


def list_(data: Data = None, json_: Json = False) -> None:
    """List the figures, and how much of each is there."""
    from .gallery_report import list_figures

    list_figures(data=data, as_json=json_)


def build(data: Data = None, out: Annotated[str, typer.Option(help="Folder of the site.")] = "out/gallery") -> None:
    """Build the site from what is there, without simulating; it opens from its index.html, offline."""
    from .gallery_report import build as build_gallery

    build_gallery(data=data, out=out)


def serve(
    out: Annotated[str, typer.Option(help="Folder of the site.")] = "out/gallery",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of this machine; 0 takes a free one.")] = 8000,
) -> None:
    """Serve the site to a browser of this machine, until Ctrl-C."""
    from .gallery_report import serve as serve_gallery

    serve_gallery(out=out, port=port)

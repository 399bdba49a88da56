"""The list of figures: it is the paper's and ours, and every figure can be made."""

from collections import Counter
from pathlib import Path

import pytest

from gradscape.envs.points import point
from gradscape.envs.registry import make
from gradscape.gallery.figures import choose_figures, read_figures

FIGURES = read_figures()


def test_the_supplements_figures_are_all_there_and_ours() -> None:
    panels = Counter(figure.caption.number for figure in FIGURES if figure.caption.number)
    assert panels == {8: 2, 9: 2, 10: 3, 11: 3, 12: 3, 13: 3, 14: 3, 15: 3}
    ours = Counter(figure.env for figure in FIGURES if not figure.caption.number)
    once = dict.fromkeys(("rope", "rolling-pin", "pinch", "torus", "cartpole"), 1)
    assert ours == once | {"swing-velocity": 3, "swing-stiffness": 3}


def test_a_figure_names_what_its_environment_has() -> None:
    planes = {(48, 1), (96, 2), (256, 4)}  # samples along each axis, and at every how many of them a gradient is
    for figure in FIGURES:
        env = make(figure.env, fidelity=figure.fidelity, device="cpu", **figure.options)
        assert point(env, figure.through).shape == (env.space.dim,), figure.id
        assert len({env.space.index(dim) for dim in figure.dims}) == len(figure.dims), figure.id
        sizes = {(512, 1)} if len(figure.dims) == 1 else planes
        assert (figure.resolution, figure.gradients) in sizes, figure.id


def test_figures_are_chosen_by_id_and_by_environment() -> None:
    assert [figure.id for figure in choose_figures(FIGURES, ["fluid-6-8", "bounce"])] == [
        "bounce-x",
        "bounce-y",
        "fluid-6-8",
    ]
    with pytest.raises(ValueError, match="no figure or environment 'fluids'"):
        choose_figures(FIGURES, ["fluids"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "needs figures"),
        ('[[figure]]\nid = "a"\nenv = "fluid"', "lacks .'dims'"),
        ('[[figure]]\nid = "a"\nenv = "fluid"\ndims = [0, 1]\ndim = 3', "unknown keys .'dim'"),
        ('[[figure]]\nid = "a"\nenv = "fluid"\ndims = [0, 1]\nsays = "It is smooth."', "unknown keys .'says'"),
        ('[[figure]]\nid = "a"\nenv = "fluid"\ndims = [0, 1, 2]', "needs one dimension or two"),
        (2 * '[[figure]]\nid = "a"\nenv = "fluid"\ndims = [0, 1]\n', "repeated: a"),
    ],
)
def test_a_wrong_list_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "figures.toml").write_text(text)
    with pytest.raises(ValueError, match=said):
        read_figures(tmp_path / "figures.toml")

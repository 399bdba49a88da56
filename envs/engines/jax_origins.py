"""Find where a gradient of JAX first is not finite: a function is evaluated and differentiated step by step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ..origins import Place, callers_line, describe_origin, in_library

MAX_STEPS = 10_000  # of a loop that is looked into, or of a program
INNER = ("jaxpr", "call_jaxpr")  # what the parameter is called that holds what a call calls
BY_RULE = ("custom_jvp_call", "custom_vjp_call")  # calls whose derivative is not that of what they call
Values = Sequence[Any]


@dataclass(frozen=True)
class _Step:
    """An operation: what it computes, which values by their keys it takes and gives, and what it is made of.

    `pull` is what differentiates it backwards where that has been compiled, as it comes again and again.
    """

    run: Callable[..., Values]
    takes: tuple[Any, ...]
    gives: tuple[Any, ...]
    name: str = ""
    place: Place | None = None
    inside: Callable[[Values], _Program | None] = lambda values: None
    pull: Callable[[Values, Values], Values] | None = None


@dataclass(frozen=True)
class _Program:
    """Operations in their order, the values that they start from, and the keys of what goes in and comes out."""

    steps: list[_Step]
    takes: tuple[Any, ...]
    gives: tuple[Any, ...]
    values: dict[Any, Any] = field(default_factory=dict)


Sweep = Callable[[_Program, Values], tuple[_Step, Values, Values] | None]


def jax_origin(fn: Callable[[Any], Any], x: Any, mode: str) -> str:
    """Return the primitive whose derivative at a point is the first that is not finite, in the order of the mode.

    Empty where all are finite, and of a program too long to look at. JAX is to compute in the precision of the point.
    """
    whole = jax.make_jaxpr(fn)(x)
    if len(whole.jaxpr.eqns) > MAX_STEPS:
        return ""
    program = _program(whole.jaxpr, whole.consts, [x], None)
    if mode == "reverse":
        return _first(program, [jnp.ones((), whole.out_avals[0].dtype)], _backwards)
    found = (_first(program, [direction], _forwards) for direction in jnp.eye(len(x), dtype=x.dtype))
    return next(filter(None, found), "")


def _first(program: _Program | None, seeds: Values, sweep: Sweep) -> str:
    """Return the innermost operation that makes derivatives which are not finite of some that are."""
    said = ""
    while program is not None and (found := sweep(program, seeds)) is not None:
        step, values, seeds = found
        said, program = describe_origin(step.name, step.place), step.inside(values)
    return said


def _backwards(program: _Program, seeds: Values) -> tuple[_Step, Values, Values] | None:
    """Return the first operation from the end whose derivatives are not finite, its values, and what arrived there."""
    values, taken = dict(program.values), []
    for step in program.steps:
        taken.append([values[key] for key in step.takes])
        values.update(zip(step.gives, step.run(*taken[-1]), strict=True))
    slopes: dict[Any, Any] = {}
    _add(slopes, program.gives, seeds)
    for step, own in zip(reversed(program.steps), reversed(taken), strict=True):
        if not any(key in slopes for key in step.gives):
            continue
        outputs = ((values[key], slopes.get(key)) for key in step.gives)
        arrived = [_zero(value) if slope is None and _is_real(value) else slope for value, slope in outputs]
        given = (step.pull or partial(_pull, step.run))(own, arrived)
        if _finite(arrived) and not _finite(given):
            return step, own, arrived
        _add(slopes, step.takes, given)
    return None


def _forwards(program: _Program, seeds: Values) -> tuple[_Step, Values, Values] | None:
    """Return the first operation whose tangents are not finite, its values, and the tangents that arrived there."""
    values, slopes = dict(program.values), dict(zip(program.takes, seeds, strict=True))
    for step in program.steps:
        own = [values[key] for key in step.takes]
        arrived = [slopes[key] if key in slopes else _zero(values[key]) for key in step.takes]
        found, given = jax.jvp(step.run, own, arrived)
        if _finite(arrived) and not _finite(given):
            return step, own, arrived
        values.update(zip(step.gives, found, strict=True))
        slopes.update(zip(step.gives, given, strict=True))
    return None


def _pull(run: Callable[..., Values], values: Values, arrived: Values) -> Values:
    """Return the derivatives by the values of what is computed of them, by those of what comes out.

    None stands for those by whole numbers and truth values, of which there are none.
    """
    found, back = jax.vjp(lambda *own: list(run(*own)), *values)
    given = back([_zero(value) if slope is None else slope for value, slope in zip(found, arrived, strict=True)])
    return [slope if _is_real(slope) else None for slope in given]


def _add(slopes: dict[Any, Any], keys: Values, given: Values) -> None:
    for key, slope in zip(keys, given, strict=True):
        if slope is not None:
            slopes[key] = slopes[key] + slope if key in slopes else slope


def _zero(value: Any) -> Any:
    """Return a slope of zero, of the type that JAX has for it."""
    return jnp.zeros_like(value) if _is_real(value) else np.zeros(np.shape(value), jax.dtypes.float0)


def _is_real(value: Any) -> bool:
    return bool(jnp.issubdtype(value.dtype, jnp.inexact))


def _finite(values: Values) -> bool:
    return all(bool(jnp.isfinite(value).all()) for value in values if value is not None and _is_real(value))


def _program(jaxpr: Any, consts: Values, values: Values, place: Place | None) -> _Program:
    """Return the equations of a jaxpr as steps; `place` is where they stand, None where each says so itself."""
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *values), strict=True))
    atoms: list[Any] = [*jaxpr.outvars, *(atom for equation in jaxpr.eqns for atom in equation.invars)]
    literals: list[Any] = [one for one in atoms if isinstance(one, core.Literal)]
    numbers = {_key(one): jnp.asarray(one.val, one.aval.dtype) for one in literals}
    steps = [_step(jaxpr, equation, place or _place(equation)) for equation in jaxpr.eqns]
    return _Program(steps, tuple(jaxpr.invars), tuple(map(_key, jaxpr.outvars)), known | numbers)


def _key(atom: Any) -> Any:
    """Return what an atom of a jaxpr is found by."""
    return id(atom) if isinstance(atom, core.Literal) else atom


def _step(jaxpr: Any, equation: Any, place: Place | None) -> _Step:
    """Return an equation as a step."""
    free = [number for number, atom in enumerate(equation.invars) if not isinstance(atom, core.Literal)]
    takes = [equation.invars[number] for number in free]
    alone = jaxpr.replace(constvars=[], invars=takes, outvars=list(equation.outvars), eqns=[equation])

    def run(*values: Any) -> Values:
        found: Values = jax.core.eval_jaxpr(alone, (), *(values[number] for number in free))
        return found

    inside = partial(_inside, equation, place)
    return _Step(run, tuple(map(_key, equation.invars)), tuple(equation.outvars), _name(equation), place, inside)


def _name(equation: Any) -> str:
    """Return what a user calls an operation: a function's name where it calls one."""
    if equation.primitive.name in BY_RULE:
        return str(equation.params["call_jaxpr"].jaxpr.debug_info.func_src_info).split(" at ")[0]
    return str(equation.params.get("name") or equation.primitive.name)


def _place(equation: Any) -> Place | None:
    said = equation.source_info.traceback
    frames = [(frame.file_name, frame.line_num) for frame in said.frames] if said else []
    return callers_line(frames, jax.__file__)


def _inside(equation: Any, place: Place | None, values: Values) -> _Program | None:
    """Return what an equation is made of at such values, None where it is one operation."""
    kind, params = equation.primitive.name, equation.params
    if kind == "scan":
        return _scan(params, values, place)
    if kind == "while":
        return _while(params, values, place)
    if kind == "cond":
        branch = _called(params["branches"][int(values[0])], place, values[1:])
        return replace(branch, takes=(None, *branch.takes))
    called = next((params[name] for name in INNER if name in params), None)
    return None if called is None or kind in BY_RULE else _called(called, place, values)


def _called(called: Any, place: Place | None, values: Values) -> _Program:
    """Return what a call computes of its values.

    JAX traces a function once: what one of its own says of lines is where that was first called. Those of a user's
    function lie in that function.
    """
    jaxpr = getattr(called, "jaxpr", called)
    file = jaxpr.debug_info.func_filename
    own = file is not None and not in_library(file, jax.__file__)
    return _program(jaxpr, getattr(called, "consts", ()), values, None if own else place)


def _scan(params: dict[str, Any], values: Values, place: Place | None) -> _Program | None:
    """Return the steps of a loop of known length: each takes items of stacks, and writes its results in others."""
    body, count, first, many = params["jaxpr"], params["length"], params["num_consts"], params["num_carry"]
    if count > MAX_STEPS:
        return None
    run = jax.jit(core.jaxpr_as_fun(body))
    pull, pull_item, pull_write = (jax.jit(partial(_pull, one)) for one in (run, _item, _write))
    inside = partial(_called, body, place)
    takes = _keys("in", 0, len(values))
    fixed, state, stacks = takes[:first], takes[first : first + many], takes[first + many :]
    shapes = [one.aval for one in body.jaxpr.outvars[many:]]
    results = _keys("result", 0, len(shapes))
    known = {**dict(zip(takes, values, strict=True)), **{("step", step): jnp.asarray(step) for step in range(count)}}
    known |= {key: jnp.zeros((count, *one.shape), one.dtype) for key, one in zip(results, shapes, strict=True)}
    steps = []
    for step in reversed(range(count)) if params["reverse"] else range(count):
        items, out = _keys("item", step, len(stacks)), _keys("out", step, len(shapes))
        after, written = _keys("state", step, many), _keys("all", step, len(shapes))
        steps.append(_Step(_item, (("step", step), *stacks), items, pull=pull_item))
        steps.append(_Step(run, (*fixed, *state, *items), (*after, *out), "scan", place, inside, pull))
        steps.append(_Step(_write, (("step", step), *results, *out), written, pull=pull_write))
        state, results = after, written
    return _Program(steps, takes, (*state, *results), known)


def _keys(name: str, step: int, count: int) -> tuple[Any, ...]:
    """Return the keys of so many values of a step."""
    return tuple((name, step, number) for number in range(count))


@jax.jit
def _item(step: Any, *stacks: Any) -> Values:
    """Return what each stack holds for a step."""
    return [stack[step] for stack in stacks]


@jax.jit
def _write(step: Any, *stacks_and_items: Any) -> Values:
    """Return stacks, the first half, with the other half's items in them."""
    half = len(stacks_and_items) // 2
    stacks, items = stacks_and_items[:half], stacks_and_items[half:]
    return [stack.at[step].set(item) for stack, item in zip(stacks, items, strict=True)]


def _while(params: dict[str, Any], values: Values, place: Place | None) -> _Program | None:
    """Return the steps of a loop that ends by a condition."""
    condition, body = (params[f"{name}_jaxpr"] for name in ("cond", "body"))
    first = params["cond_nconsts"]
    start = first + params["body_nconsts"]
    goes_on, run = jax.jit(core.jaxpr_as_fun(condition)), jax.jit(core.jaxpr_as_fun(body))
    takes, steps, inside = _keys("in", 0, len(values)), list[_Step](), partial(_called, body, place)
    state, now = takes[start:], values[start:]
    while bool(goes_on(*values[:first], *now)[0]):
        if len(steps) == MAX_STEPS:
            return None
        after = _keys("state", len(steps), len(now))
        steps.append(_Step(run, (*takes[first:start], *state), after, "while", place, inside))
        state, now = after, run(*values[first:start], *now)
    return _Program(steps, takes, state, dict(zip(takes, values, strict=True)))

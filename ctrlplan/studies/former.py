"""`compare` and `sweep` with the arguments of 0.1, which work for one release with a notice; remove with 0.3."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from ctrlplan._renamed import warn_renamed
from ctrlplan.studies import comparison as _comparison
from ctrlplan.studies import sweep as _sweep
from ctrlplan.studies.benefit import Benefit, Choices, benefit_of
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.measures import MEASURES, Measure, Run, checked_names
from ctrlplan.studies.monte_carlo import monte_carlo
from ctrlplan.studies.plans import standard_plans, waypoints_given
from ctrlplan.trajectories import TrigSpline

P = ParamSpec("P")
R = TypeVar("R")

_MEASURES = {
    "only": "measures= with these names",
    "measure": 'measures= with a Measure(title, unit, "run", function), whose function is given a run',
}
_WORTH = {"worth": "benefit(comparison, loop)"}
_OF_SWEEP = {
    "alpha": "plans = ctrlplan.studies.standard_plans(waypoints, alpha)",
    "title": "report(path, title)",
    "parameters": "parameters= of compare",
}


def _compare(function: Callable[P, R]) -> Callable[P, R]:
    """Comparison that takes the old arguments only, measure and worth as well."""

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        _notices("compare", _MEASURES | _WORTH, kwargs)
        worth = kwargs.pop("worth", False)
        if not isinstance(worth, bool | Mapping):
            raise TypeError(f"worth must be True, False or a mapping of choices, got {worth!r}")
        given = dict(kwargs)
        kwargs = _with_measures(kwargs)
        found: Any = function(*args, **kwargs)
        if worth is False:
            return found
        loop = args[0] if args else kwargs["loop"]
        return found.with_benefit(_benefit(found, loop, {} if worth is True else dict(worth), given))

    return called


def _benefit(found: Comparison, loop: Any, choices: dict[str, Any], given: Mapping[str, Any]) -> Benefit:
    """Benefit as `compare` made it with `worth`, a mapping of choices and of options of its own."""
    if not found.waypoints or found.experiment is None:
        raise ValueError("worth needs waypoints, in the place of plans or as waypoints, got none")
    own = {entry.name: choices.pop(entry.name) for entry in fields(Choices) if entry.name in choices}
    if "alpha" not in own:
        shapes = (plan.alpha for plan in found.plans.values() if isinstance(plan, TrigSpline))
        own["alpha"] = next(shapes, given.get("alpha", 1.0))
    texts = {name: choices.pop(name) for name in ("units", "title") if name in choices}
    texts.setdefault("units", found.units)
    measures = {name: given[name] for name in ("measure", "measures") if name in given}
    last = "measure" in choices  # which was given the time of the last waypoint as well
    measures |= {name: choices.pop(name) for name in ("only", "measure", "measures") if name in choices}
    choices["measures"] = _with_measures(measures, last).get("measures")
    return benefit_of(replace(found.experiment, **choices), loop, Choices(**own), **texts)


def _swept(function: Callable[P, R]) -> Callable[P, R]:
    """Sweep that takes the old arguments params, only, measure, worth, alpha, title and parameters as well."""

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        if len(args) > 4:
            warn_renamed("sweep with executor and progress by position", "executor= and progress=")
            kwargs |= dict(zip(("executor", "progress"), args[4:], strict=False))
            args = args[:4]
        known = _MEASURES | _OF_SWEEP | _WORTH
        table = kwargs.get("params")
        drawn = "values" not in kwargs and (len(args) < 2 or args[1] is None)
        if drawn and table is None:
            raise TypeError("sweep() missing 1 required positional argument: 'values'; for draws use monte_carlo")
        if drawn:
            warn_renamed("sweep with params=", "monte_carlo(loop, draws, plans, timepts)")
        _notices("sweep", known, kwargs)
        worth = kwargs.pop("worth", False)
        if worth is not False and not drawn:
            raise (ValueError if isinstance(worth, bool | Mapping) else TypeError)(
                "worth must be False in a sweep over values, which has no place for it, got "
                f"{worth!r:.80}; give compare's result at the value of interest to benefit"
            )
        texts: dict[str, Any] = {name: kwargs.pop(name) for name in ("title", "parameters") if name in kwargs}
        kwargs = _with_measures(_named(args, kwargs))
        if "alpha" in kwargs:
            kwargs |= _through(kwargs.get("plans", ()), kwargs.pop("alpha"))
        if not drawn:
            return function(**kwargs)  # type: ignore[call-arg]
        return _drawn(kwargs, texts, worth)

    return called


def _named(args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
    """All arguments by name."""
    named = dict(zip(("build", "values", "plans", "timepts"), args, strict=False))
    for name in named:
        if name in kwargs:
            raise TypeError(f"sweep() got multiple values for argument {name!r}")
    return named | kwargs


def _drawn(given: dict[str, Any], texts: Mapping[str, Any], worth: Any) -> Any:
    """Draws as `sweep` made them with `params`."""
    given.pop("values", None)
    given.pop("parameter", None)
    loop, table = given.pop("build"), given.pop("params")
    found = monte_carlo(loop, table, **given)
    nominal = found.nominal
    if texts:
        parameters = dict(texts.get("parameters") or {}) | nominal.parameters
        nominal = replace(nominal, title=texts.get("title", nominal.title), parameters=parameters)
    if worth is not False:
        nominal = nominal.with_benefit(_benefit(nominal, loop, {} if worth is True else dict(worth), given))
    return replace(found, nominal=nominal)


def _through(plans: Any, alpha: Any) -> dict[str, Any]:
    """Plans through waypoints, with the shape that `sweep` was given."""
    if isinstance(plans, Mapping):
        return {"plans": plans}
    points = waypoints_given(plans)
    return {"plans": standard_plans(points, alpha), "waypoints": points}


def _notices(function: str, known: Mapping[str, str], given: Mapping[str, Any]) -> None:
    for name in known:
        if name in given:
            warn_renamed(f"{name}= of {function}", known[name])


def _with_measures(given: dict[str, Any], last: bool = False) -> dict[str, Any]:
    """Arguments with `only` and `measure` as `measures`."""
    if not {"only", "measure"} & set(given):
        return given
    rest = {name: value for name, value in given.items() if name not in ("only", "measure", "measures")}
    only, measure, own = given.get("only"), given.get("measure"), given.get("measures")
    if own is not None and not isinstance(own, Mapping):
        raise TypeError(f"measures must be a mapping of names to Measure, got {type(own).__name__}")
    measures = dict(own or {})
    if measure is not None:
        if not callable(measure):
            raise TypeError(f"measure must be a function of a plan and a response, got {measure!r:.80}")
        measures["measure"] = Measure("measure", "", "run", _Called(measure, last))
    if only is None:
        return rest | ({"measures": measures} if measures else {})
    only = tuple(only) if isinstance(only, Iterator) else only
    known = [*measures, *MEASURES]
    names = checked_names(only, known if measure is None or isinstance(only, str) else [*known, *only], "only")
    listed = [
        replace(one, name=name) for name, one in measures.items() if not one.of or one.of == "run" or name in names
    ]
    return rest | {"measures": [*listed, *(name for name in names if name in MEASURES)]}


class _Called:
    """Function of a run that calls one of a plan and a response."""

    def __init__(self, function: Callable[..., Mapping[str, float]], last: bool) -> None:
        self.function, self.last = function, last

    def __call__(self, run: Run) -> Mapping[str, float]:
        more = (run.last,) if self.last else ()
        found = self.function(run.plan, run.response, *more)
        if not isinstance(found, Mapping):
            raise TypeError(f"measure must return a mapping of names to numbers, got {type(found).__name__}")
        return found


compare = _compare(_comparison.compare)
sweep = _swept(_sweep.sweep)

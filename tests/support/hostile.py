"""Texts that would be something else where they were not taken as text, and a study in which all texts are such."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np

import ctrlplan as cp
from ctrlplan.studies import Measure, Study, sections
from ctrlplan.studies.benefit import Benefit
from ctrlplan.studies.grids import Grid
from ctrlplan.studies.required_durations import RequiredDuration

HIT = "window.hit=1"
MARKUP = {
    "attribute": f'"><img src=x onerror={HIT}>',
    "attribute in single quotes": f"'><svg onload={HIT}>",
    "attribute without a bracket": f'x" onmouseover="{HIT}" autofocus onfocus="{HIT}',
    "title": f"</title><script>{HIT}</script>",
    "script": f"</script><script>{HIT}</script>",
    "style": f"</style><script>{HIT}</script>",
    "drawing": f"</svg></figure><script>{HIT}</script>",
    "comment": f"--><script>{HIT}</script>",
    "comment ended otherwise": f"--!><script>{HIT}</script>",
    "comment left open": "<!-- ",
    "data section": f"]]><script>{HIT}</script>",
    "template": "{{ 7 * 7 }} {% raw %} {# #}",
    "template of another kind": f"${{{HIT}}} `+{HIT}+`",
    "address": f"javascript:{HIT}",
    "reference to a character": "&lt;b&gt; &#60;i&#62; &amp;",
    "escapes": "\\u003cscript\\u003e \\x3c %3Cscript%3E",
    "base": '<base href="//evil.example/"><meta http-equiv=refresh content=0>',
    "ids": 'id="x" href="#y" url(#z)',
    "styles": 'red;background:url("//evil.example/x")',
    "property": "__proto__",
    "method": "constructor",
    "formats": "%s {0} {name} %(x)s \\g<1> \\1",
}
NOT_WRITTEN_SO = {
    "formula": "$x$",
    "wrong formula": r"$\frac$",
    "command": r"\frac{1}{0}",
    "one dollar": "5 $",
    "dollars": "$$",
    "escaped dollar": r"\$x\$ \\$",
    "hidden label": "_a",
    "hidden label of a child": "_child0",
    "underscores": "__",
    "powers": "a_b^2",
    "emoji": "\N{ROCKET} fast",
    "Chinese": "\u8ba1\u5212",
    "Arabic": "\u062e\u0637\u0629",
}
CONTROL = {
    "zero": "a\x00b",
    "escape": "\x1b[31mred\x1b[0m",
    "bell": "\x07\x08",
    "lines": "one\ntwo\r\nthree\ttabbed",
    "direction": "\u202egnp.exe\u2066",
    "file name of another encoding": "caf\udce9",
    "no character": "\uffff\ufffe",
    "long": "w" * 5000,
    "long words": "word " * 1000,
}
TEXTS = MARKUP | NOT_WRITTEN_SO | CONTROL


MOVE = [
    cp.Waypoint.from_jets(0.0, x=[0, 0, 0], z=[10, 0, 0]),
    cp.Waypoint.from_jets(9.0, x=[8, 0, 0], z=[9, 0, 0]),
]


@cache
def crane():
    """Two plans through a crane, under plain names."""
    plans = {"one": cp.PolySpline(MOVE), "two": cp.TrigSpline(MOVE, alpha=1.0)}
    return cp.compare(lambda name, plan: cp.plants.crane_loop(cp.plants.Crane(), plan), plans, np.linspace(0, 12, 61))


def study(text, drawn=True):
    """A study of a crane with every section, all of whose texts `text` makes of the plain ones."""
    axis = text("z2").replace(".", "·")  # which labels must not have
    axes, control, names = ["x", axis], text("u"), [text("one"), text("two")]
    plans = (cp.PolySpline(MOVE, labels=axes), cp.TrigSpline(MOVE, alpha=1.0, labels=axes))
    measures = {"key": Measure(text("measure"), text("unit")), "other": Measure(text("other"), "{y}^2 s")}

    def response(found):
        labels = [*found.output_labels, axis, control]
        rows = np.concatenate([found.outputs, found.outputs[1:2], found.outputs[2:3]])
        return SimpleNamespace(time=found.time, outputs=rows, output_labels=labels)

    found = replace(
        crane(),
        plans=dict(zip(names, plans, strict=True)),
        responses=dict(zip(names, map(response, crane().responses.values()), strict=True)),
        metrics={name: {"key": 1.0 + k, "other": float(k)} for k, name in enumerate(names)},
        outputs=("x", axis),
        controls=(control,),
        waypoints=tuple(MOVE),
        units={axis: text("m") for axis in axes} | {control: text("N")},
        title=text("title"),
        parameters={text("parameter"): text("value")},
        notes=(text("note"),),
        marks={names[0]: text("mark")},
        measures=measures,
        failures={text("failed"): text("reason")},
    )
    grid = Grid(
        text("grid"),
        text("grid unit"),
        np.array([1.0, 2.0]),
        np.array([0.0, 1.0]),
        np.array([[1.0, 2.0], [3.0, 0.5]]),
        {text("rival"): np.array([1.5, 2.5])},
    )
    required = (RequiredDuration(text("need"), 1.0, text("limit of it"), text("kept")),)
    worth = Benefit(found, {text("bounded"): 2.0}, required, (grid,), 1.0, text("worth note"))
    speed = text("quantity")
    fast = cp.fastest(plans[0], {speed: 9.0}, lambda jet: {speed: np.hypot(jet[1, 0], jet[1, 1])}) if drawn else None
    curves = sections.Curves(
        text("across"),
        text("up"),
        np.arange(3.0),
        {text("curve"): np.arange(3.0), text("bend"): np.ones(3)},
        caption=text("caption"),
    )
    figures = (
        sections.PlanCurves(),
        sections.Responses(),
        sections.CraneTime(),
        sections.CranePaths(),
        sections.CraneMotion(),
        curves,
    )
    limited = () if fast is None else (sections.FastestMove(fast),)
    return Study(
        text("name"),
        text("heading"),
        replace(found, benefit=worth if drawn else None),
        summary=text("summary"),
        notes=(text("finding"),),
        sections=(
            *(figures if drawn else ()),
            sections.AnimatedCrane(),
            *limited,
            sections.ClaimTable((text("claim"),), (grid,)),
        ),
    )


SHOWN = (
    *("one", "two", "measure", "unit", "other", "parameter", "value", "mark", "failed", "reason"),
    *("grid", "rival", "summary", "finding", "claim", "heading"),
)
"""Roles whose texts stand on the page itself, figures and worth aside."""


def mixed(offset):
    """Each role another text: a function for `study`."""
    texts = list(TEXTS.values())
    roles = {}

    def text(role):
        k = roles.setdefault(role, len(roles))
        return f"{texts[(offset + k) % len(texts)]} {role}"

    return text

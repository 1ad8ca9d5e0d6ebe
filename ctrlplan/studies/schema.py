"""JSON Schema of study files, for editors; written from the tables that the reader of study files checks."""

from __future__ import annotations

import json
from pathlib import Path

from ctrlplan._types import Data
from ctrlplan.studies.files import STUDY

SCHEMA = Path(__file__).with_name("study.schema.json")
"""The schema in the package: `schema_text` of the families and loops of the package."""


def study_schema() -> Data:
    """JSON Schema (draft 7) of study files.

    Returns
    -------
    dict
        A file that violates it is rejected by `load_study` as well. Conditions
        between entries (increasing times, labels that exist) and numbers that
        JSON does not have (nan, inf) are not part of it.
    """
    head = {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Study file of ctrlplan",
        "description": "Input of `ctrlplan report` and `ctrlplan plan`.",
    }
    return head | STUDY.schema()


def schema_text() -> str:
    """The schema as text."""
    return json.dumps(study_schema(), indent=1, ensure_ascii=False) + "\n"

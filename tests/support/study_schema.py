"""Study files as the JSON Schema of the package and the reader of study files judge them."""

import json
import math
from functools import cache
from pathlib import Path

from jsonschema import Draft7Validator

from ctrlplan.studies.files import STUDY
from ctrlplan.studies.reading import Reader, StudyError
from ctrlplan.studies.schema import SCHEMA


@cache
def validator():
    """Validator of the schema in the package."""
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    Draft7Validator.check_schema(schema)
    return Draft7Validator(schema)


def schema_errors(data):
    """What the schema finds wrong with the data of a study file."""
    return [error.message for error in validator().iter_errors(data)]


def structure_error(data):
    """What the reader finds wrong with the structure of the data of a study file; None for nothing."""
    try:
        STUDY.read(data, "", Reader(Path("study.toml")))
    except StudyError as error:
        return str(error)
    return None


def is_json(data):
    """Whether all numbers are finite, as in JSON."""
    if isinstance(data, dict):
        return all(map(is_json, data.values()))
    if isinstance(data, list):
        return all(map(is_json, data))
    try:
        return not isinstance(data, (int, float)) or math.isfinite(data)
    except OverflowError:  # beyond the range of floats
        return False

"""List the mutants; the tests of one that is added must pass without it and fail with it."""

from tests.mutants.catalogue.evaluation import EVALUATION
from tests.mutants.catalogue.inference import INFERENCE
from tests.mutants.catalogue.mapping import MAPPING
from tests.mutants.catalogue.model import MODEL
from tests.mutants.catalogue.planning import PLANNING
from tests.mutants.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (*MODEL, *MAPPING, *INFERENCE, *PLANNING, *EVALUATION)

__all__ = ["MUTANTS"]

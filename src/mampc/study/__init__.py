"""Studies: a TOML file that says what to compare, and the runs it leads to.

The commented template is the built-in study mampc/studies/quadruple-tank.toml.
"""

from mampc.study.loading import builtin_studies, load_study, parse_study, template
from mampc.study.running import StudyResult, run_study
from mampc.study.schema import Study

__all__ = ["Study", "StudyResult", "builtin_studies", "load_study", "parse_study", "run_study", "template"]

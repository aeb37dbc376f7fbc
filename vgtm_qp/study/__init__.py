"""Studies: the paper's figures and sweeps over methods, from one command, resumable, on many processes."""

from vgtm_qp.study.study import STUDIES, Study, run_study

__all__ = ["STUDIES", "Study", "run_study"]

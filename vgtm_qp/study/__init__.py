"""Studies: the paper's figures and sweeps over methods, from one command, resumable, on many processes."""

from vgtm_qp.study.study import STUDIES, Study, find_study, run_study, study_tasks

__all__ = ["STUDIES", "Study", "find_study", "run_study", "study_tasks"]

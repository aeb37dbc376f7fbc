"""Problem files: what a person writes, checked and typed, with one message per mistake."""

from vgtm_qp.problem.load import bundled_problems, load_problem, problem_schema
from vgtm_qp.problem.path_file import PathTable, read_path
from vgtm_qp.problem.problem import Problem

__all__ = ["PathTable", "Problem", "bundled_problems", "load_problem", "problem_schema", "read_path"]

"""The command ``vgtm``: one file a command; what a command imports is imported when it runs."""

from vgtm_qp.cli.app import main

__all__ = ["main"]

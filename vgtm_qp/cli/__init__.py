"""The command ``vgtm``; what one of its commands needs is imported when it runs."""

from vgtm_qp.cli.app import main

__all__ = ["main"]

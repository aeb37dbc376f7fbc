"""A maneuver in the forms that other programs read: ``export_maneuver`` and one file a family of formats."""

from vgtm_qp.export.formats import FORMATS, export_maneuver

__all__ = ["FORMATS", "export_maneuver"]

"""Records out of files as people have them."""

from mampc.identification.export.inspection import Inspection, inspect_export
from mampc.identification.export.reading import Export, read_export, read_one
from mampc.identification.export.table import ReadingOptions

__all__ = ["Export", "Inspection", "ReadingOptions", "inspect_export", "read_export", "read_one"]

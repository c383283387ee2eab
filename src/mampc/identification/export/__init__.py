"""Records out of files as people have them."""

from mampc.identification.export.inspection import Inspection, inspect_export
from mampc.identification.export.reading import Export, ReadingOptions, read_export, read_one

__all__ = ["Export", "Inspection", "ReadingOptions", "inspect_export", "read_export", "read_one"]

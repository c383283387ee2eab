"""Records out of files as people have them."""

from mampc.identification.export.reading import Export, ReadingOptions, read_export, read_one

__all__ = ["Export", "ReadingOptions", "read_export", "read_one"]

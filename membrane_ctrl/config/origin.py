"""Members that a file of ours may have: the program and the commit that wrote it."""

from firmware_iface.settings import Section


class OriginSection(Section):
    """A file whose first members are those of `model.program.file_origin`; files from elsewhere
    have none of them.
    """

    program: str = ""
    commit: str = ""

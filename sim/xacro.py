"""A URDF's text, from its file or from the xacro file that writes it. Pure (reads files, keeps no state)."""

from pathlib import Path

from sightline.protocol.errors import ConfigError


def urdf_text(path: Path) -> str:
    """The URDF in `path`; a `.xacro` is expanded, which needs the extra. Raises ConfigError."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; `urdf` names a file beside the robot's .toml")
    if path.suffix == ".xacro":
        return _expanded(path)
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None


def _expanded(path: Path) -> str:
    try:
        from xacrodoc import XacroDoc
    except ImportError:
        raise ConfigError(f"{path}: a xacro file needs xacrodoc; install it with: pip install 'sightline[xacro]'"
                          ) from None
    try:
        return str(XacroDoc.from_file(str(path)).to_urdf_string())
    except Exception as error:  # the package raises whatever its parser does
        raise ConfigError(f"{path}: xacro cannot expand it: {str(error).splitlines()[0][:160]}") from None

"""Device plug-ins behind the ports of `sightline.robot_side.ports`.

May import: `protocol`, `robot_side`; the package of its device when it is opened.
Interface: The entry points that `pyproject.toml` names; `gpio_low` also sets pins low without the drive.
"""

"""The folders at the top of the repository as packages below one import root: `protocol/` is `sightline.protocol`."""

from setuptools import find_packages, setup

FOLDERS = ("protocol", "robot_side", "vision_side", "sim", "conformance", "operator_side", "evaluation", "training",
           "benchmarks")

setup(
    package_dir={"sightline": "sightline", **{f"sightline.{folder}": folder for folder in FOLDERS}},
    packages=["sightline"] + [f"sightline.{name}" for folder in FOLDERS
                              for name in (folder, *(f"{folder}.{part}" for part in find_packages(folder)))],
    package_data={"": ["*", "**/*"]},
    exclude_package_data={"": ["*.pyc", "**/*.pyc"]},
    include_package_data=False,
)

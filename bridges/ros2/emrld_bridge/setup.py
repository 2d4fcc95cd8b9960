"""Installs the package into a ROS 2 workspace; `colcon build` calls it."""

from setuptools import setup

NAME = "emrld_bridge"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/turtlebot3.launch.py"]),
        (f"share/{NAME}/config", ["config/parameters.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="emrld-jax",
    maintainer_email="emrld-jax@example.com",
    description="Policies of emrld-jax drive a TurtleBot3, and adapt to it.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"run = {NAME}.run:main",
            f"deadman = {NAME}.deadman:main",
        ],
    },
)

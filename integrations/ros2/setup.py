"""Installed by colcon, as any package of ament_python."""

from setuptools import setup

setup(
    name="heliograph_ros",
    version="0.5.0",
    packages=["heliograph_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/heliograph_ros"]),
        ("share/heliograph_ros", ["package.xml"]),
    ],
    install_requires=["setuptools", "heliograph[live]"],
    entry_points={"console_scripts": ["estimator = heliograph_ros.node:main"]},
)

"""Builds the package with colcon."""

from setuptools import setup

setup(
    name="limber_stop", version="0.1.0", packages=["limber_stop"],
    data_files=[("share/ament_index/resource_index/packages", ["resource/limber_stop"]),
                ("share/limber_stop", ["package.xml"]),
                ("share/limber_stop/launch", ["launch/limber.launch.py"])],
    install_requires=["setuptools"],
    entry_points={"console_scripts": ["stop_node = limber_stop.stop_node:main"]})

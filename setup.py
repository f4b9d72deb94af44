"""Build of the ament_python package; pip, colcon and rosdep read the same metadata from here and package.xml."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "plow_twin"
# colcon runs this file through a link in another folder
README = Path(__file__).resolve().parent / "README.md"

# ROS 2 Jazzy as wheels; with a sourced ROS 2, this extra is not needed
ROS_WHEELS = '; platform_system == "Linux" and platform_machine == "x86_64"'

EXTRAS = {
    "ros": [
        f"ros-jazzy-rclpy[fastrtps]==7.1.6{ROS_WHEELS}",
        f"ros-jazzy-common-interfaces==5.3.6{ROS_WHEELS}",
    ],
    # mcap 1.4 has no `Writer.flush`; the tests use 1.6
    "record": ["mcap>=1.6", "rosbags>=0.11", "lz4>=4.0.2", "zstandard>=0.22", "isal>=1.6"],
    "mqtt": ["paho-mqtt>=1.6"],
    "opcua": ["asyncua>=2.1"],
    "sparkplug": ["paho-mqtt>=1.6", "protobuf>=4.21.12"],
    "influx": ["influxdb-client>=1.36"],
    "metrics": ["prometheus-client>=0.19"],
    "dashboard": ["starlette>=0.31", "uvicorn>=0.27", "websockets>=13"],
    "view": ["rerun-sdk>=0.41", "matplotlib>=3.8"],
    "study": ["matplotlib>=3.8", "pyarrow>=14", "jinja2>=3.1", "rainflow>=3.2"],
    "dask": ["distributed>=2024.1"],
    "bench": ["matplotlib>=3.8", "scikit-sundae>=1.0", "mujoco>=3.2", "exudyn>=1.9", "heyoka>=7", "filterpy>=2.0"],
    "docs": ["mkdocs>=1.6,<2", "mkdocstrings[python]>=0.26"],
    "test": [
        "pytest>=7.4",
        "pytest-timeout",
        "pytest-xdist>=3.4",
        "hypothesis",
        "amqtt>=0.11",
        "websockets>=13",
    ],
}
EXTRAS["dev"] = [
    *EXTRAS["docs"],
    *EXTRAS["test"],
    "codespell",
    "ruff",
    "mypy",
    "types-PyYAML",
    "types-jsonschema",
    "build",
    "colcon-common-extensions",
    "pandas>=2",
    "psutil",
]

setup(
    name=NAME,
    version="0.2.0",
    description="Digital twin of a coal plough head: contact-impact motion in its guide, live on ROS 2",
    long_description=README.read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="plow_twin maintainers",
    author_email="maintainers@users.noreply.github.com",
    license="Apache-2.0",
    license_files=["LICENSE"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Manufacturing",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Topic :: Scientific/Engineering :: Physics",
        "Typing :: Typed",
    ],
    keywords=["digital twin", "contact", "impact", "clearance", "wear", "coal plough", "longwall", "ROS 2"],
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "study/templates/*.j2", "dashboard/page/*", "telemetry/opcua/nodesets/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(glob("config/*.[jrxy]*"))),
        (f"share/{NAME}/config/sros2", ["config/sros2/policy.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        # `lib/plow_twin` has the executables under their ROS names, which are too general for a bin folder
        (f"lib/{NAME}", sorted(glob("scripts/*"))),
    ],
    python_requires=">=3.11,<3.13",
    install_requires=[
        # the only libraries of the model and the solver
        "numpy>=1.26",
        "scipy>=1.11",
        # bounded, because kernel/arrays.py, kernel/linked.py and kernel/compiler.py use internals of numba
        "numba>=0.59,<0.69",
        # scene files and the command line
        "click>=8.1",
        "jsonschema>=4.10",
        "PyYAML>=6",
        "rich>=13",
    ],
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "plow-twin = plow_twin.cli:main",
            "plow-twin-node = plow_twin.ros.main:main",
            "plow-twin-publisher = plow_twin.demo.excitation_publisher:main",
        ]
    },
)

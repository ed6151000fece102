from xml.etree import ElementTree

import numpy as np
import pytest

from sim.p3at import (
    CENTER_OF_MASS_M,
    LENGTH_M,
    SKID_TRACK_M,
    TIRE_FRICTION,
    TOP_WHEEL_SPEED_RAD_S,
    TRACK_M,
    URDF,
    WHEEL_RADIUS_M,
    WHEEL_TORQUE_N_M,
    WHEELBASE_M,
    WHEELS,
    WIDTH_M,
    P3at,
)
from sim.world import PHYSICS_HZ, World

ROBOT = ElementTree.parse(URDF).getroot()


def numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def inertia_of(link: ElementTree.Element) -> tuple[float, np.ndarray]:
    tensor = link.find("inertial/inertia").attrib
    assert all(float(tensor[name]) == 0 for name in ("ixy", "ixz", "iyz"))
    mass = float(link.find("inertial/mass").attrib["value"])
    return mass, np.array([float(tensor[name]) for name in ("ixx", "iyy", "izz")])


def test_body_inertia_is_that_of_a_uniform_box() -> None:
    """The second moments of a box, summed over a fine grid of cells."""
    mass, tensor = inertia_of(ROBOT.find("link[@name='base']"))
    height = 2 * (0.277 - CENTER_OF_MASS_M)
    cells = [(np.arange(200) + 0.5) / 200 * size - size / 2 for size in (LENGTH_M, WIDTH_M, height)]
    xx, yy, zz = (np.mean(cell**2) for cell in cells)
    np.testing.assert_allclose(tensor, mass * np.array([yy + zz, xx + zz, xx + yy]), rtol=1e-4)


@pytest.mark.parametrize("name", WHEELS)
def test_wheel_inertia_is_that_of_a_uniform_cylinder(name: str) -> None:
    mass, tensor = inertia_of(ROBOT.find(f"link[@name='{name}']"))
    radius = (np.arange(2000) + 0.5) / 2000 * WHEEL_RADIUS_M
    across = np.sum(radius**3) / np.sum(radius) / 2  # mean of x^2 over a disc
    width = 0.075
    along = np.mean(((np.arange(2000) + 0.5) / 2000 * width - width / 2) ** 2)
    expected = mass * np.array([across + along, 2 * across, across + along])
    np.testing.assert_allclose(tensor, expected, rtol=1e-4)


def test_dimensions_and_mass_are_the_makers() -> None:
    assert sum(inertia_of(link)[0] for link in ROBOT.findall("link")) == pytest.approx(12.0)
    for name in WHEELS:
        joint = ROBOT.find(f"joint[@name='{name}']")
        x, y, z = numbers(joint.find("origin").attrib["xyz"])
        assert abs(x) == WHEELBASE_M / 2
        assert abs(y) == TRACK_M / 2
        assert z == WHEEL_RADIUS_M
        assert (x > 0) == name.startswith("front")
        assert (y > 0) == ("left" in name)
        limit = joint.find("limit").attrib
        assert float(limit["effort"]) == WHEEL_TORQUE_N_M
        assert float(limit["velocity"]) == TOP_WHEEL_SPEED_RAD_S
    boxes = [
        (numbers(c.find("origin").attrib["xyz"]), numbers(c.find("geometry/box").attrib["size"]))
        for c in ROBOT.find("link[@name='base']").findall("collision")
    ]
    tops = np.max([origin + size / 2 for origin, size in boxes], axis=0)
    np.testing.assert_allclose(tops, [LENGTH_M / 2, WIDTH_M / 2, 0.277], atol=1e-9)


def test_the_world_uses_these_inertias() -> None:
    with World() as world:
        robot = P3at(world, np.zeros(3))
        info = world.bullet.getDynamicsInfo(robot.body, -1, physicsClientId=world.client)
    mass, tensor = inertia_of(ROBOT.find("link[@name='base']"))
    assert info[0] == mass
    np.testing.assert_allclose(info[2], tensor)


def driven(left_rad_s: float, right_rad_s: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses at every 1/30 s and the wheels' final angles of a robot that starts at rest."""
    with World() as world:
        world.start_physics()
        robot = P3at(world, np.array([1.0, 2.0, 0.5]))
        poses = [robot.pose()]
        for _ in range(round(seconds * 30)):
            robot.drive(left_rad_s, right_rad_s)
            world.step(PHYSICS_HZ // 30)
            poses.append(robot.pose())
        return np.array(poses), robot.wheel_angles()


def test_placed_where_it_was_told() -> None:
    with World() as world:
        robot = P3at(world, np.array([1.0, 2.0, 0.5]))
        np.testing.assert_allclose(robot.pose(), [1, 2, 0.5], atol=1e-12)
        robot.place(np.array([-3.0, 1.0, -2.0]))
        np.testing.assert_allclose(robot.pose(), [-3, 1, -2], atol=1e-12)


def test_a_straight_run_agrees_with_the_encoders() -> None:
    poses, wheels = driven(2.0, 2.0, 4.0)
    steady = np.hypot(*(poses[-1] - poses[30])[:2])
    assert steady == pytest.approx(2.0 * WHEEL_RADIUS_M * 3, abs=2e-3)
    assert wheels == pytest.approx([8.0, 8.0], rel=0.01)
    assert abs(poses[-1][2] - 0.5) < 0.01


def test_the_tires_have_the_friction_they_are_given() -> None:
    """PyBullet passes over a friction that is set together with dampings."""
    with World() as world:
        for friction in (TIRE_FRICTION, 0.05):
            robot = P3at(world, np.zeros(3), friction)
            for wheel in range(world.bullet.getNumJoints(robot.body, physicsClientId=world.client)):
                info = world.bullet.getDynamicsInfo(robot.body, wheel, physicsClientId=world.client)
                assert info[1] == friction


def test_wheels_spin_on_a_slippery_floor() -> None:
    """At rest, all wheels are set to 0.44 m/s at once: friction mu lets the body follow at mu g."""
    friction, time_s = 0.03, 0.5
    with World() as world:
        world.start_physics()
        robot = P3at(world, np.zeros(3), friction)
        world.step(PHYSICS_HZ // 2)
        start = robot.pose()[0]
        robot.drive(4.0, 4.0)
        world.step(round(time_s * PHYSICS_HZ))
        way = robot.pose()[0] - start
        turned = robot.wheel_angles().mean() * WHEEL_RADIUS_M
    assert way == pytest.approx(0.5 * friction * 9.81 * time_s**2, rel=0.1)
    assert turned > 4 * way


@pytest.mark.parametrize("sign", [1, -1])
def test_turning_on_the_spot_skids_as_coulomb_friction_says(sign: int) -> None:
    """PyBullet's friction pyramid is not isotropic: within an eighth, averaged over headings."""
    poses, wheels = driven(-3.0 * sign, 3.0 * sign, 6.0)
    yaw = np.unwrap(poses[:, 2])[-1] - 0.5
    assert np.sign(yaw) == sign
    track_m = (wheels[1] - wheels[0]) * WHEEL_RADIUS_M / yaw
    assert track_m == pytest.approx(SKID_TRACK_M, rel=0.125)
    assert np.hypot(*(poses[:, :2] - [1, 2]).T).max() < 0.01  # it does not wander


def test_wheels_respect_the_top_speed() -> None:
    _, wheels = driven(50.0, 50.0, 2.0)
    assert wheels.max() <= 2.0 * TOP_WHEEL_SPEED_RAD_S * 1.001
    assert wheels.min() > 1.8 * TOP_WHEEL_SPEED_RAD_S

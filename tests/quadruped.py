"""A checkout of MuJoCo Menagerie with one robot of our own, of the size of a Go2, for tests without a network."""

from pathlib import Path

LEG = """
<body name="{name}_hip" pos="{x} {y} 0"> <joint name="{name}_hip_joint" axis="1 0 0" range="-1 1"/>
  <inertial pos="0 0 0" mass="0.7" diaginertia="1e-3 1e-3 1e-3"/>
  <body name="{name}_thigh" pos="0 {out} 0"> <joint name="{name}_thigh_joint" axis="0 1 0" range="-1.5 3.4"/>
    <inertial pos="0 0 -0.05" mass="1.1" diaginertia="6e-3 6e-3 1e-3"/>
    <body name="{name}_calf" pos="0 0 -0.213"> <joint name="{name}_calf_joint" axis="0 1 0" range="-2.7 -0.8"/>
      <inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-4"/>
      <geom name="{name}" size="0.022" pos="0 0 -0.213" condim="3" friction="0.8"/> </body> </body> </body>"""
SERVO = '<position joint="{name}_{joint}_joint" kp="50" ctrlrange="{low} {high}" forcerange="-24 24"/>'
MOTOR = '<motor joint="{name}_{joint}_joint" gear="20"/>'
RANGES = {"hip": (-0.3, 0.3), "thigh": (-1.4, 3.2), "calf": (-2.6, -0.9)}
LEGS = {"FL": (0.19, 0.05, 0.09), "FR": (0.19, -0.05, -0.09), "RL": (-0.19, 0.05, 0.09), "RR": (-0.19, -0.05, -0.09)}
HOME = [0, 0, 0.28, 1, 0, 0, 0, *([0, 0.9, -1.8] * 4)]
MASS = 7.0 + 4 * (0.7 + 1.1 + 0.3)  # kg


def write_checkout(folder: Path, *, keyframe: str = "home", actuator: str = SERVO, more: str = "") -> Path:
    """Write unitree_go2, with `more` in its MJCF, and return the folder to name in MENAGERIE_ROOT."""
    legs = "".join(LEG.format(name=name, x=x, y=y, out=out) for name, (x, y, out) in LEGS.items())
    actuators = "".join(
        actuator.format(name=name, joint=joint, low=low, high=high)
        for name in LEGS
        for joint, (low, high) in RANGES.items()
    )
    path = folder / "unitree_go2" / "scene_mjx.xml"
    path.parent.mkdir()
    path.write_text(f"""<mujoco model="go2"> <compiler angle="radian" autolimits="true"/>
      <default> <joint damping="2" armature="0.01"/> </default>
      <worldbody> <light pos="0 0 3"/> <geom name="floor" type="plane" size="0 0 0.05"/>
        <body name="base" pos="0 0 0.445"> <freejoint/> <inertial pos="0 0 0" mass="7" diaginertia="0.1 0.1 0.02"/>
          <geom type="box" size="0.19 0.05 0.06"/>
          <geom name="shell" type="box" size="0.2 0.06 0.07" contype="0" conaffinity="0" group="2"/> {legs} </body>
      </worldbody>
      <actuator> {actuators} </actuator> {more}
      <keyframe> <key name="{keyframe}" qpos="{" ".join(map(str, HOME))}"/> </keyframe>
    </mujoco>""")
    return folder

"""The steps of commissioning in their order: nothing turns before signs are known, and the robot stands last."""

from swarm.onboard.commission.core import device_steps, imu_steps, motor_steps, uwb_steps
from swarm.onboard.commission.core.procedure import ProcedureStep

STEPS = (
    ProcedureStep("ready", "the balancer, its devices and the gyro's zero", device_steps.ready),
    ProcedureStep("bus", "the I2C bus and its clock", device_steps.bus),
    ProcedureStep("battery", "the battery", device_steps.battery),
    ProcedureStep("buttons", "the buttons", device_steps.buttons),
    ProcedureStep("display", "the display", device_steps.display),
    ProcedureStep("imu", "the axes of the IMU", imu_steps.imu),
    ProcedureStep("encoders", "the signs of the encoders, by hand", imu_steps.encoders),
    ProcedureStep("motors", "one motor at a time, at low power", motor_steps.motors),
    ProcedureStep("stop", "a stop", motor_steps.stop),
    ProcedureStep("watchdog", "the watchdog of the motors", motor_steps.watchdog),
    ProcedureStep("uwb", "the UWB module and the anchors", uwb_steps.uwb),
    ProcedureStep("offset", "by how much its UWB ranges are too long", uwb_steps.offset),
    ProcedureStep("radio", "links to neighbours", device_steps.radio),
    ProcedureStep("held", "wheels that follow the tilt, at low power, in the hand", motor_steps.held),
    ProcedureStep("standing", "standing", motor_steps.standing),
)

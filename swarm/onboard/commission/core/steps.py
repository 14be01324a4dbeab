"""The steps of commissioning in their order: nothing turns before signs are known, and the robot stands last."""

from swarm.onboard.commission.core import device_steps, imu_steps, motor_steps, uwb_steps
from swarm.onboard.commission.core.procedure import Step

STEPS = (
    Step("ready", "the balancer, its devices and the gyro's zero", device_steps.ready),
    Step("bus", "the I2C bus and its clock", device_steps.bus),
    Step("battery", "the battery", device_steps.battery),
    Step("buttons", "the buttons", device_steps.buttons),
    Step("display", "the display", device_steps.display),
    Step("imu", "the axes of the IMU", imu_steps.imu),
    Step("encoders", "the signs of the encoders, by hand", imu_steps.encoders),
    Step("motors", "one motor at a time, at low power", motor_steps.motors),
    Step("stop", "a stop", motor_steps.stop),
    Step("watchdog", "the watchdog of the motors", motor_steps.watchdog),
    Step("uwb", "the UWB module and the anchors", uwb_steps.uwb),
    Step("offset", "by how much its UWB ranges are too long", uwb_steps.offset),
    Step("radio", "links to neighbours", device_steps.radio),
    Step("held", "wheels that follow the tilt, at low power, in the hand", motor_steps.held),
    Step("standing", "standing", motor_steps.standing),
)

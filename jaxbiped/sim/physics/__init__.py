"""Physics by contract: what moves the robot, and says what sensors and statistics go by.

    compliant       MJX's rigid-body dynamics on our own ground; differentiable, the default
    mjx_contacts    MuJoCo's own contacts by MJX's solver
    c_mujoco        C MuJoCo, many robots in lockstep on the host: shares no physics with the other two

An engine moves `contract.Physics` on by a tick and returns what it saw at the start of it (`contract.Seen`). Sensors,
statistics, controller and inverse kinematics are the same for all of them (`tick`).
"""

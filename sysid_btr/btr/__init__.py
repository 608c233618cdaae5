"""Back to Reality: controllers are searched in a model, tried on the robot, and the trials correct the model.

Zagal, Delpiano, Ruiz-del-Solar, Self-modeling in humanoid soccer robots, Robotics and Autonomous Systems 57 (2009),
doi:10.1016/j.robot.2009.03.010.
"""

"""Control: boxes, policies, closed-loop inverse kinematics, safety rules and runs."""

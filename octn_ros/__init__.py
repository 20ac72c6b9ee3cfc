"""Neural OCT fields for robot-guided surgery: fit a C-scan, find its surface, plan a laser path over it.

An independent implementation of OCTN (Prakash, McNabb, Codd, Lin: "OCTN: Neural OCT Representations for
Robot-Guided Precision Intervention"). Importing this package loads neither torch nor ROS.
"""

__version__ = "0.1.0"

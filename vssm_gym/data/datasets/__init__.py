"""Write episodes and recordings as data sets that other libraries read: Minari's and LeRobot's formats."""

"""Find the path of a laser scanner by scan matching and a pose graph with loop closure: what ours is compared with.

    clouds       points of several scans as a surface: places, normals
    matching     a scan to a surface: point-to-line ICP with the information of its outcome
    correlative  the same without a good start: all poses of a window, by bounds
    submaps      keyframes, and groups of them that scans are matched to
    loops        keyframes that may see an older submap, and the checks that a match must pass
    graph        the nodes and factors, and their optimum, by GTSAM in a process of its own (``gtsam_program``)
    run          a whole log

The parts are those of Cartographer and Karto; GTSAM alone is foreign, and only ``gtsam_program`` imports it.
"""

"""Draw pictures and videos of single runs.

``explorer_run`` runs one exploration and ``navigator_run`` one navigation task, each with a recording of it
(``*_recording``), pictures (``*_pictures``) and the page of its video (``explorer``, ``navigator``). They share floor
plans (``plans``, ``plan_panel``), the robot's ``track``, the elements of ``pictures``, the ``run_files`` and the
``writer`` of MP4 files, whose pages draw their static parts once. Of :mod:`vssm_gym.eval` this package imports every
part but ``bench`` and ``studies``.
"""

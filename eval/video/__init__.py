"""Draw pictures and videos of single runs.

``writer`` writes MP4 files from pages whose static parts are drawn once. ``explorer_run`` runs one exploration with a
``recording`` of it, drawn by ``pictures`` and ``explorer``. Of :mod:`vssm_gym.eval` this package imports every part but
``bench`` and ``studies``.
"""

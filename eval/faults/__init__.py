"""Give filters and agents faulty images, and measure what they believe: ``vssm-gym faults NAME``.

``injectors`` defines the faults, for any stream of images. Each further module measures one kind of user of the images.
Faults may use every other part of :mod:`vssm_gym.eval`; only the command line imports them.
"""

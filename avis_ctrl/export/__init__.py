"""From a certified design to the files that a rig's processor loads: `avis export`.

    design folder -> sampled controller, rounded -> C99, .mat, test vectors -> certificate of the rounded numbers

Every figure of the certificate is computed from the numbers in controller.json. Method: docs/export.md.
"""

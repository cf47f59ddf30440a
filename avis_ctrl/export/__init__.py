"""From a certified design to the files that a rig's processor uses: `avis export`.

    design folder -> sampled controller, rounded -> C99, .mat, test vectors -> certificate of the rounded numbers

Every number of the certificate is computed from controller.json. Method: docs/export.md.
"""

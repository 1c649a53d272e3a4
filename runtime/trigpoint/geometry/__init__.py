"""Numpy kernels of the paper "Multiview Image-Based Localization", one idea a file.

Image points are undistorted and normalised (on the plane z = 1); poses are `Rigid3`.
"""

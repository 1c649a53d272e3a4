"""Some of many images, spread evenly."""


def spread_indices(num_images: int, num: int) -> list[int]:
    """Choose so many indices, spread evenly; all, where there are not as many."""
    num = min(num, num_images)
    return [i * num_images // num for i in range(num)]

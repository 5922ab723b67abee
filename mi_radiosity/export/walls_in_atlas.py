from .atlas import whole


def cut_at_walls(solution, size):
    return whole(solution.model)

"""Fast marching on a masked grid: arrival costs from a set of nodes, second order where it can be.

Solves |grad u| = rate on the nodes of a regular grid (Sethian 1999, "Fast marching methods",
SIAM Review 41, sections 5 and 6). The result is a candidate only: what a proof needs is checked
by :mod:`limber.planning.bound.subsolution`, however the candidate was found.
"""

import numpy as np

from limber.compiled import compiled


@compiled
def march(rate, active, known, values, spacing):
    """Return arrival costs ``u`` [nx, ny, nz]; infinite where no active node leads.

    Args:
        rate: Cost per metre at the nodes [1/m], shape [nx, ny, nz].
        active: Nodes that may be entered, bool [nx, ny, nz].
        known: Active nodes whose value is given, bool [nx, ny, nz].
        values: Their values, shape [nx, ny, nz].
        spacing: Distance between nodes [m].
    """
    nx, ny, nz = rate.shape
    count = nx * ny * nz
    u = np.full(count, np.inf)
    done = np.zeros(count, np.bool_)
    heap = np.empty(count, np.int64)
    place = np.full(count, -1, np.int64)
    size = 0
    flat_rate, flat_active = rate.ravel(), active.ravel()
    flat_known, flat_values = known.ravel(), values.ravel()
    steps = np.array([ny * nz, nz, 1])
    shape = np.array([nx, ny, nz])
    at = np.empty(3, np.int64)
    for node in range(count):
        if flat_known[node] and flat_active[node]:
            u[node] = flat_values[node]
            size = _push(heap, place, u, size, node)
    while size > 0:
        node = heap[0]
        size = _pop(heap, place, u, size)
        done[node] = True
        _coordinates(node, shape, at)
        for axis in range(3):
            for side in (-1, 1):
                if not 0 <= at[axis] + side < shape[axis]:
                    continue
                near = node + side * steps[axis]
                if done[near] or flat_known[near] or not flat_active[near]:
                    continue
                cost = _arrival(near, u, done, flat_rate[near], steps, shape, spacing)
                if cost < u[near]:
                    u[near] = cost
                    if place[near] < 0:
                        size = _push(heap, place, u, size, near)
                    else:
                        _rise(heap, place, u, place[near])
    return u.reshape((nx, ny, nz))


@compiled
def _coordinates(node, shape, out):
    out[2] = node % shape[2]
    out[1] = (node // shape[2]) % shape[1]
    out[0] = node // (shape[2] * shape[1])


@compiled
def _arrival(node, u, done, rate, steps, shape, spacing):
    """Solve sum_i w_i (u - t_i)^2 = rate^2 over the axes whose upwind neighbour is done."""
    at = np.empty(3, np.int64)
    _coordinates(node, shape, at)
    t, w, nearest = np.empty(3), np.empty(3), np.empty(3)
    used = 0
    for axis in range(3):
        best, value = 0, np.inf
        for side in (-1, 1):
            if 0 <= at[axis] + side < shape[axis]:
                near = node + side * steps[axis]
                if done[near] and u[near] < value:
                    best, value = side, u[near]
        if best == 0:
            continue
        t[used], w[used], nearest[used] = value, 1.0, value
        if 0 <= at[axis] + 2 * best < shape[axis]:
            far = node + 2 * best * steps[axis]
            if done[far] and u[far] <= value:
                t[used], w[used] = (4.0 * value - u[far]) / 3.0, 2.25
        used += 1
    target = (rate * spacing) ** 2
    # Drop the axis whose neighbour lies highest until the solution lies above all that are used.
    while used > 0:
        a, b, c, top = 0.0, 0.0, -target, -np.inf
        last = 0
        for i in range(used):
            a += w[i]
            b += w[i] * t[i]
            c += w[i] * t[i] * t[i]
            if nearest[i] > top:
                top, last = nearest[i], i
        root = b * b - a * c
        if root >= 0.0:
            solution = (b + np.sqrt(root)) / a
            if solution >= top:
                return solution
        if used == 1:
            return nearest[0] + rate * spacing
        used -= 1
        t[last], w[last], nearest[last] = t[used], w[used], nearest[used]
    return np.inf


@compiled
def _push(heap, place, u, size, node):
    heap[size] = node
    place[node] = size
    _rise(heap, place, u, size)
    return size + 1


@compiled
def _rise(heap, place, u, index):
    node = heap[index]
    while index > 0:
        parent = (index - 1) // 2
        if u[heap[parent]] <= u[node]:
            break
        heap[index] = heap[parent]
        place[heap[index]] = index
        index = parent
    heap[index] = node
    place[node] = index


@compiled
def _pop(heap, place, u, size):
    size -= 1
    place[heap[0]] = -2
    node = heap[size]
    index = 0
    while True:
        child = 2 * index + 1
        if child >= size:
            break
        if child + 1 < size and u[heap[child + 1]] < u[heap[child]]:
            child += 1
        if u[node] <= u[heap[child]]:
            break
        heap[index] = heap[child]
        place[heap[index]] = index
        index = child
    if size > 0:
        heap[index] = node
        place[node] = index
    return size

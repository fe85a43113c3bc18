"""Fast marching on a masked grid: arrival costs from a set of nodes, second order where possible.

Solves |grad u| = rate on the nodes of a regular grid (Sethian 1999, "Fast marching methods", SIAM
Review 41, sections 5 and 6). The result is only a candidate:
:mod:`limber.planning.certificate.subsolution` checks what a proof needs, however the candidate was
found.
"""

import numpy as np

from limber.core.numerics.compiled import compiled


@compiled
def neighbours(active):
    """Return numbers of the nodes ``active`` [nx, ny, nz], -1 elsewhere, their indices in the flat
    grid [n], and the numbers of their neighbours below and above along each axis [n, 6]."""
    shape = np.array(active.shape)
    steps = np.array([shape[1] * shape[2], shape[2], 1])
    flat = active.ravel()
    numbers = np.full(flat.size, -1, np.int32)
    indices = np.flatnonzero(flat)
    for k in range(len(indices)):
        numbers[indices[k]] = k
    near = np.full((len(indices), 6), -1, np.int32)
    for k in range(len(indices)):
        for axis in range(3):
            at = indices[k] // steps[axis] % shape[axis]
            if at > 0:
                near[k, 2 * axis] = numbers[indices[k] - steps[axis]]
            if at + 1 < shape[axis]:
                near[k, 2 * axis + 1] = numbers[indices[k] + steps[axis]]
    return numbers.reshape(active.shape), indices, near


@compiled
def march(rate, near, known, values, edges):
    """Return arrival costs [n], infinite where unreachable, from cost per metre [n], neighbours [n,
    6], values [n] at ``known`` nodes, and the grid's edges [3] [m]."""
    count = len(rate)
    u = np.full(count, np.inf)
    done = np.zeros(count, np.bool_)
    heap = np.empty(count, np.int32)
    heap_index = np.full(count, -1, np.int32)
    used = np.empty((4, 3))
    size = 0
    for node in range(count):
        if known[node]:
            u[node] = values[node]
            size = _push(heap, heap_index, u, size, node)
    while size > 0:
        node = heap[0]
        size = _pop(heap, heap_index, u, size)
        done[node] = True
        for side in range(6):
            other = near[node, side]
            if other < 0 or done[other] or known[other]:
                continue
            cost = _arrival(other, u, done, rate[other], edges, near, used)
            if cost < u[other]:
                u[other] = cost
                if heap_index[other] < 0:
                    size = _push(heap, heap_index, u, size, other)
                else:
                    _rise(heap, heap_index, u, heap_index[other])
    return u


@compiled
def _arrival(node, u, done, rate, edges, near, used):
    """Solve sum_i w_i (u - t_i)^2 = rate^2 over the axes whose upwind neighbour is done. ``used``
    [4, 3] is room for t, w, the neighbour's value and the edge of each axis."""
    count = 0
    for axis in range(3):
        best, value = -1, np.inf
        for side in (2 * axis, 2 * axis + 1):
            other = near[node, side]
            if other >= 0 and done[other] and u[other] < value:
                best, value = side, u[other]
        if best < 0:
            continue
        weight = 1.0 / (edges[axis] * edges[axis])
        used[0, count], used[1, count], used[2, count] = value, weight, value
        used[3, count] = edges[axis]
        far = near[near[node, best], best]
        if far >= 0 and done[far] and u[far] <= value:
            used[0, count], used[1, count] = (4.0 * value - u[far]) / 3.0, 2.25 * weight
        count += 1
    # Drop the axis with the highest neighbour until the solution exceeds all used neighbours.
    while count > 0:
        a, b, c, top = 0.0, 0.0, -rate * rate, -np.inf
        last = 0
        for i in range(count):
            t, w = used[0, i], used[1, i]
            a += w
            b += w * t
            c += w * t * t
            if used[2, i] > top:
                top, last = used[2, i], i
        root = b * b - a * c
        if root >= 0.0:
            solution = (b + np.sqrt(root)) / a
            if solution >= top:
                return solution
        if count == 1:
            return used[2, 0] + rate * used[3, 0]
        count -= 1
        for k in range(4):
            used[k, last] = used[k, count]
    return np.inf


@compiled
def _push(heap, heap_index, u, size, node):
    heap[size] = node
    heap_index[node] = size
    _rise(heap, heap_index, u, size)
    return size + 1


@compiled
def _rise(heap, heap_index, u, index):
    node = heap[index]
    while index > 0:
        parent = (index - 1) // 2
        if u[heap[parent]] <= u[node]:
            break
        heap[index] = heap[parent]
        heap_index[heap[index]] = index
        index = parent
    heap[index] = node
    heap_index[node] = index


@compiled
def _pop(heap, heap_index, u, size):
    size -= 1
    heap_index[heap[0]] = -2
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
        heap_index[heap[index]] = index
        index = child
    if size > 0:
        heap[index] = node
        heap_index[node] = index
    return size

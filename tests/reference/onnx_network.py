"""Write small networks in the ONNX format, byte by byte."""

import struct

FLOAT, INT64, DOUBLE = 1, 7, 11


def linear_network(weights, *, inputs=(1, 4), outputs=(1, 1), element=DOUBLE, index=False):
    """Return the bytes of a network: output = input @ weights, or the index of its largest entry.

    Args:
        weights: Rows of the matrix.
        inputs: Shape of the input; a name stands for a free dimension.
        outputs: Shape of the output.
        element: FLOAT or DOUBLE.
        index: Whether the output is that index, an INT64.
    """
    flat = [value for row in weights for value in row]
    raw = struct.pack(f"<{len(flat)}{'f' if element == FLOAT else 'd'}", *flat)
    shape = b"".join(_number(1, size) for size in (len(weights), len(weights[0])))
    matrix = shape + _number(2, element) + _bytes(8, b"W") + _bytes(9, raw)
    product = b"Q" if index else b"u"
    nodes = _bytes(1, _bytes(1, b"x") + _bytes(1, b"W") + _bytes(2, product) + _bytes(4, b"MatMul"))
    if index:
        axis = _bytes(1, b"axis") + _number(3, 1) + _number(20, 2)
        largest = _bytes(1, b"Q") + _bytes(2, b"u") + _bytes(4, b"ArgMax") + _bytes(5, axis)
        nodes += _bytes(1, largest)
    graph = (
        nodes
        + _bytes(2, b"graph")
        + _bytes(5, matrix)
        + _bytes(11, _value(b"x", inputs, element))
        + _bytes(12, _value(b"u", outputs, INT64 if index else element))
    )
    return _number(1, 8) + _bytes(7, graph) + _bytes(8, _number(2, 13))


def _value(name, shape, element):
    dims = b"".join(
        _bytes(1, _bytes(2, size.encode()) if isinstance(size, str) else _number(1, size))
        for size in shape
    )
    return _bytes(1, name) + _bytes(2, _bytes(1, _number(1, element) + _bytes(2, dims)))


def _varint(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _number(field, value):
    return _varint(field << 3) + _varint(value)


def _bytes(field, value):
    return _varint(field << 3 | 2) + _varint(len(value)) + value

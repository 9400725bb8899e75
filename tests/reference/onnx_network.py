"""Write small networks in the ONNX format, byte by byte."""

import struct

FLOAT, DOUBLE = 1, 11


def linear_network(weights, *, inputs=(1, 4), outputs=(1, 1), element=DOUBLE):
    """Return the bytes of a network with one operation: output = input @ weights.

    Args:
        weights: Rows of the matrix.
        inputs: Shape of the input; a name stands for a free dimension.
        outputs: Shape of the output.
        element: FLOAT or DOUBLE.
    """
    flat = [value for row in weights for value in row]
    raw = struct.pack(f"<{len(flat)}{'f' if element == FLOAT else 'd'}", *flat)
    shape = b"".join(_number(1, size) for size in (len(weights), len(weights[0])))
    matrix = shape + _number(2, element) + _bytes(8, b"W") + _bytes(9, raw)
    node = _bytes(1, b"x") + _bytes(1, b"W") + _bytes(2, b"u") + _bytes(4, b"MatMul")
    graph = (
        _bytes(1, node)
        + _bytes(2, b"graph")
        + _bytes(5, matrix)
        + _bytes(11, _value(b"x", inputs, element))
        + _bytes(12, _value(b"u", outputs, element))
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

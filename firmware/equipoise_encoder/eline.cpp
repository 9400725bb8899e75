#include "eline.h"

namespace eline {

namespace {

constexpr char kHex[] = "0123456789ABCDEF";

// A place to write in, that remembers how far it is.
struct Writer {
  char *out;
  size_t length;

  void put(char c) { out[length++] = c; }

  void unsigned_number(uint32_t value) {
    char digits[10];
    uint8_t n = 0;
    do {
      digits[n++] = static_cast<char>('0' + value % 10);
      value /= 10;
    } while (value != 0);
    while (n > 0) put(digits[--n]);
  }

  void signed_number(int32_t value) {
    uint32_t size = static_cast<uint32_t>(value);
    if (value < 0) {
      put('-');
      size = 0u - size;  // right for -2^31, too
    }
    unsigned_number(size);
  }

  size_t finish() {
    const uint8_t crc = crc8(out, length);
    put('*');
    put(kHex[crc >> 4]);
    put(kHex[crc & 15]);
    put('\n');
    return length;
  }
};

bool is_letter(char c) { return (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z'); }
bool is_digit(char c) { return c >= '0' && c <= '9'; }

// Write a word of 1 to `most` characters; false where it is none.
bool word(Writer &writer, const char *text, uint8_t most, bool letter_first, bool dots) {
  uint8_t n = 0;
  for (; text[n] != '\0'; ++n) {
    const char c = text[n];
    const bool first = n == 0 ? is_letter(c) || (!letter_first && is_digit(c)) : true;
    const bool known = is_letter(c) || is_digit(c) || c == '_' || c == '-' || (dots && c == '.');
    if (!first || !known || n == most) return false;
    writer.put(c);
  }
  return n > 0;
}

}  // namespace

uint8_t crc8(const char *data, size_t length) {
  uint8_t crc = 0;
  for (size_t i = 0; i < length; ++i) {
    crc ^= static_cast<uint8_t>(data[i]);
    for (uint8_t bit = 0; bit < 8; ++bit) {
      crc = static_cast<uint8_t>((crc & 1) ? (crc >> 1) ^ 0x8C : crc >> 1);
    }
  }
  return crc;
}

size_t format_reading(char *out, const Reading &reading) {
  Writer writer{out, 0};
  writer.put('E');
  writer.put(',');
  writer.unsigned_number(reading.seq);
  writer.put(',');
  writer.unsigned_number(reading.t_us);
  writer.put(',');
  writer.signed_number(reading.counts);
  writer.put(',');
  writer.put(kHex[reading.flags & 15]);
  return writer.finish();
}

size_t format_banner(char *out, const char *name, const char *firmware, uint32_t counts_per_rev,
                     uint32_t rate_hz) {
  if (counts_per_rev == 0 || counts_per_rev > 999999999u) return 0;
  if (rate_hz == 0 || rate_hz > 999999u) return 0;
  Writer writer{out, 0};
  writer.put('I');
  writer.put(',');
  if (!word(writer, name, 32, true, false)) return 0;
  writer.put(',');
  if (!word(writer, firmware, 16, false, true)) return 0;
  writer.put(',');
  writer.unsigned_number(counts_per_rev);
  writer.put(',');
  writer.unsigned_number(rate_hz);
  return writer.finish();
}

bool Requests::feed(char byte) {
  if (byte == '\n' || byte == '\r') {
    const bool asked = line_ == 1;
    line_ = 0;
    return asked;
  }
  line_ = (byte == '?' && line_ == 0) ? 1 : 2;
  return false;
}

void Quadrature::step(uint8_t ab) {
  // Row: the lines before; column: after. In the order 00, 01, 11, 10 the count falls.
  static const int8_t kStep[4][4] = {
      {0, -1, 1, 2},
      {1, 0, 2, -1},
      {-1, 2, 0, 1},
      {2, 1, -1, 0},
  };
  ab &= 3;
  const int8_t step = kStep[ab_][ab];
  ab_ = ab;
  if (step == 2) {
    illegal_ = true;
  } else {
    counts_ += static_cast<uint32_t>(static_cast<int32_t>(step));
  }
}

uint16_t Pace::due(uint32_t now_us) {
  uint16_t periods = 0;
  while (static_cast<int32_t>(now_us - next_us_) >= 0) {
    next_us_ += period_us_;
    ++periods;
  }
  return periods;
}

}  // namespace eline

//! An adaptive binary range coder: probable symbols cost less than a bit.
//!
//! Compared with Rice codes on the same residuals it saves a fifth of a tool's batch and nearly half of
//! a press at rest, because a Rice code spends at least one bit on a number.
//!
//! The layout of a coded part is written once, over [`Coder`]: an encoder writes the given value and
//! returns it; a decoder ignores the given value and returns the decoded one. After G. N. N. Martin,
//! "Range encoding" (1979); the probabilities adapt as in LZMA.

use crate::ProtocolError;

/// Probabilities are counted in parts of 2^12.
const CHANCE_BITS: u32 = 12;

/// Adaptation rate of a probability: 1/16 of the difference, because a datagram is short.
const FOLLOW: u32 = 4;

/// Below this the range is renormalised by a byte.
const RANGE_MIN: u32 = 1 << 24;

/// Bytes that a decoder looks ahead; as many may be missing at the end, and count as zero.
const AHEAD: usize = 4;

/// Most bits of the magnitude of a [`Number`].
const MAGNITUDE_BITS: usize = 26;

/// The probability that the next bit of one kind is 0, in parts of 4096.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chance(u16);

impl Chance {
    /// No prior knowledge.
    pub(super) const EVEN: Self = Self(1 << (CHANCE_BITS - 1));

    /// A one is rare: one of 128.
    pub(super) const RARE: Self = Self(4064);

    /// A one is expected in `ones` of 256 cases.
    pub(super) const fn of_one(ones: u8) -> Self {
        Self(4096 - 16 * ones as u16 - 8)
    }

    fn bound(self, range: u32) -> u32 {
        (range >> CHANCE_BITS) * u32::from(self.0)
    }

    fn follow(&mut self, bit: bool) {
        if bit {
            self.0 -= self.0 >> FOLLOW;
        } else {
            self.0 += ((1 << CHANCE_BITS) - self.0) >> FOLLOW;
        }
    }
}

/// Either end of the code.
pub(super) trait Coder {
    /// One bit of a kind.
    fn bit(&mut self, chance: &mut Chance, bit: bool) -> Result<bool, ProtocolError>;

    /// The low `bits` bits of a number without prior knowledge.
    fn raw(&mut self, bits: u32, value: u32) -> Result<u32, ProtocolError> {
        let mut out = 0;
        for i in (0..bits).rev() {
            let mut even = Chance::EVEN;
            let bit = self.bit(&mut even, value >> i & 1 == 1)?;
            out = out << 1 | u32::from(bit);
        }
        Ok(out)
    }
}

/// Writes.
pub(super) struct RangeEncoder {
    low: u64,
    range: u32,
    out: Vec<u8>,
    /// Where the coded part begins.
    start: usize,
}

impl RangeEncoder {
    /// Appends to the bytes of `out`.
    pub(super) fn after(out: Vec<u8>) -> Self {
        let start = out.len();
        Self {
            low: 0,
            range: u32::MAX,
            out,
            start,
        }
    }

    /// Propagates a carry into the bytes already written.
    fn carry(&mut self) {
        if self.low >> 32 == 0 {
            return;
        }
        self.low &= u64::from(u32::MAX);
        for byte in self.out[self.start..].iter_mut().rev() {
            *byte = byte.wrapping_add(1);
            if *byte != 0 {
                return;
            }
        }
    }

    fn shift(&mut self) {
        self.out.push((self.low >> 24) as u8);
        self.low = self.low << 8 & u64::from(u32::MAX);
    }

    /// All bytes: the shortest number that ends the code.
    pub(super) fn finish(mut self) -> Vec<u8> {
        let end = self.low + u64::from(self.range);
        for bytes in 0..=AHEAD {
            let rest = (1_u64 << (32 - 8 * bytes)) - 1;
            let value = (self.low + rest) & !rest;
            if value < end {
                self.low = value;
                self.carry();
                for _ in 0..bytes {
                    self.shift();
                }
                break;
            }
        }
        self.out
    }
}

impl Coder for RangeEncoder {
    fn bit(&mut self, chance: &mut Chance, bit: bool) -> Result<bool, ProtocolError> {
        let bound = chance.bound(self.range);
        if bit {
            self.low += u64::from(bound);
            self.range -= bound;
            self.carry();
        } else {
            self.range = bound;
        }
        chance.follow(bit);
        while self.range < RANGE_MIN {
            self.shift();
            self.range <<= 8;
        }
        Ok(bit)
    }
}

/// Reads.
pub(super) struct RangeDecoder<'a> {
    code: u32,
    range: u32,
    bytes: &'a [u8],
    taken: usize,
    what: &'static str,
}

impl<'a> RangeDecoder<'a> {
    /// Reads all of `bytes`; `what` names them in errors.
    pub(super) fn new(bytes: &'a [u8], what: &'static str) -> Self {
        let mut decoder = Self {
            code: 0,
            range: u32::MAX,
            bytes,
            taken: 0,
            what,
        };
        (0..AHEAD).for_each(|_| decoder.shift());
        decoder
    }

    fn shift(&mut self) {
        let byte = self.bytes.get(self.taken).copied().unwrap_or(0);
        self.code = self.code << 8 | u32::from(byte);
        self.taken += 1;
    }

    /// Checks that no bytes follow.
    pub(super) fn finish(self) -> Result<(), ProtocolError> {
        let needed = self.taken - AHEAD;
        // A code never ends in a zero byte, which would be redundant.
        let padded = self.bytes.len() > needed && self.bytes.last() == Some(&0);
        let extra = self.bytes.len().saturating_sub(self.taken) + usize::from(padded);
        if extra == 0 {
            return Ok(());
        }
        Err(ProtocolError::TrailingBytes {
            what: self.what,
            extra: if padded { 1 } else { extra },
        })
    }
}

impl Coder for RangeDecoder<'_> {
    fn bit(&mut self, chance: &mut Chance, _: bool) -> Result<bool, ProtocolError> {
        let bound = chance.bound(self.range);
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
            self.range -= bound;
        } else {
            self.range = bound;
        }
        chance.follow(bit);
        while self.range < RANGE_MIN {
            if self.taken >= self.bytes.len() + AHEAD {
                return Err(ProtocolError::DatagramTruncated { what: self.what });
            }
            self.shift();
            self.range <<= 8;
        }
        Ok(bit)
    }
}

/// A signed number that is usually small: the number of bits of its magnitude in unary, each with its
/// own probability, then its sign with another, and the bits below the highest uncoded.
#[derive(Debug, Clone)]
pub(super) struct Number {
    more: [Chance; MAGNITUDE_BITS],
    negative: Chance,
}

impl Number {
    /// Starts with the probabilities, in parts of 256, that the magnitude has more than 0, 1, 2... bits;
    /// the last one holds for all that follow.
    pub(super) fn new(more: &[u8]) -> Self {
        let last = more.last().copied().unwrap_or(128);
        let more = |i| Chance::of_one(more.get(i).copied().unwrap_or(last));
        Self {
            more: std::array::from_fn(more),
            negative: Chance::EVEN,
        }
    }

    /// A number that is rarely negative.
    pub(super) fn mostly_positive(more: &[u8]) -> Self {
        Self {
            negative: Chance::RARE,
            ..Self::new(more)
        }
    }

    /// A number with a normal distribution whose deviation has this many bits. A number of `i` bits has
    /// more bits with the probability P(|x| >= 2^i) / P(|x| >= 2^(i-1)); the tails are weighted slightly
    /// higher.
    pub(super) fn around(bits: u32) -> Self {
        let more: [u8; MAGNITUDE_BITS] = std::array::from_fn(|i| match i as i32 - bits as i32 {
            ..=-4 => 249,
            -3 => 243,
            -2 => 230,
            -1 => 200,
            0 => 140,
            1 => 60,
            _ => 30,
        });
        Self::new(&more)
    }

    /// Codes a number. A number that is too large is rejected.
    pub(super) fn code(&mut self, coder: &mut impl Coder, v: i32) -> Result<i32, ProtocolError> {
        let wanted = (u32::BITS - v.unsigned_abs().leading_zeros()) as usize;
        if wanted > MAGNITUDE_BITS {
            return Err(ProtocolError::OutOfRange {
                what: "a difference",
                detail: format!("{v}, more than {MAGNITUDE_BITS} bits"),
            });
        }
        let mut bits = 0;
        while bits < MAGNITUDE_BITS && coder.bit(&mut self.more[bits], wanted > bits)? {
            bits += 1;
        }
        if bits == 0 {
            return Ok(0);
        }
        let negative = coder.bit(&mut self.negative, v < 0)?;
        let below = bits as u32 - 1;
        let magnitude = (1 << below | coder.raw(below, v.unsigned_abs())?) as i32;
        Ok(if negative { -magnitude } else { magnitude })
    }

    /// The same for three at once.
    pub(super) fn code3(
        &mut self,
        coder: &mut impl Coder,
        v: [i32; 3],
    ) -> Result<[i32; 3], ProtocolError> {
        let [x, y, z] = v;
        Ok([
            self.code(coder, x)?,
            self.code(coder, y)?,
            self.code(coder, z)?,
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn coded(numbers: &[i32]) -> Vec<u8> {
        let mut encoder = RangeEncoder::after(vec![0xff]);
        let mut model = Number::new(&[128]);
        for n in numbers {
            model.code(&mut encoder, *n).unwrap();
        }
        encoder.finish()
    }

    proptest! {
        #[test]
        fn numbers_of_any_size_come_back(numbers in proptest::collection::vec((-(1 << 26) + 1)..(1_i32 << 26), 0..200), small in 0..26) {
            let numbers: Vec<i32> = numbers.iter().map(|n| n >> small).collect();
            let bytes = coded(&numbers);
            prop_assert_eq!(bytes[0], 0xff);
            let mut decoder = RangeDecoder::new(&bytes[1..], "test");
            let mut model = Number::new(&[128]);
            for n in &numbers {
                prop_assert_eq!(model.code(&mut decoder, 0).unwrap(), *n);
            }
            decoder.finish().unwrap();
        }
    }

    #[test]
    fn thousand_zeros_cost_few_bytes() {
        assert!(coded(&[0; 1000]).len() < 20);
    }

    #[test]
    fn a_number_that_is_too_large_is_refused() {
        let mut encoder = RangeEncoder::after(Vec::new());
        assert!(Number::new(&[128]).code(&mut encoder, 1 << 26).is_err());
    }
}

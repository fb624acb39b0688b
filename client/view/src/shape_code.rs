//! Encodes the displacements of the drawn nodes, once for all pages.

use palpate_tissue::Vec3;

/// Number of this message, see `WIRE.md`.
pub(crate) const KIND: u8 = 2;

/// Step of displacements, m: a fifth of the smallest change that is sent.
const STEP_M: f32 = 1e-5;

/// A node is sent again when it has moved by this number of steps since it was sent. It bounds the error of a drawn
/// node: 20 µm and half a step.
const CHANGE_MIN: i32 = 2;

/// The tissue at one displayed time, as the solver's thread hands it over.
#[derive(Debug, Clone, Default)]
pub(crate) struct ShapeSample {
    pub(crate) version: u32,
    /// The displayed time, µs.
    pub(crate) time_us: f64,
    /// Wall time of the solve, ms since 1970.
    pub(crate) made_ms: f64,
    /// Displacement of each drawn node, m.
    pub(crate) displacements: Vec<[f32; 3]>,
    pub(crate) reactions: Vec<ShownReaction>,
}

/// The force on a tool and its contact points.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ShownReaction {
    pub(crate) participant: u16,
    pub(crate) force: Vec3,
    pub(crate) at: Vec3,
    /// Position and force of each contact point.
    pub(crate) contacts: Vec<[Vec3; 2]>,
}

/// A shape as messages: the change since the shape before, and the whole.
#[derive(Debug, Clone)]
pub(crate) struct ShapeCode {
    pub(crate) sequence: u32,
    pub(crate) change: Vec<u8>,
    pub(crate) full: Vec<u8>,
}

/// The displacements that pages have, in steps.
#[derive(Debug, Default)]
pub(crate) struct ShapeEncoder {
    version: u32,
    sequence: u32,
    sent: Vec<[i16; 3]>,
}

impl ShapeEncoder {
    /// Number of the newest shape.
    pub(crate) fn sequence(&self) -> u32 {
        self.sequence
    }

    /// Encodes the next shape. `wants_full` asks for the whole as well; it is empty otherwise.
    pub(crate) fn encode(&mut self, sample: &ShapeSample, wants_full: bool) -> ShapeCode {
        if self.version != sample.version || self.sent.len() != sample.displacements.len() {
            self.version = sample.version;
            self.sent = vec![[0; 3]; sample.displacements.len()];
        }
        self.sequence = self.sequence.wrapping_add(1);
        let mut moved = Vec::new();
        for (i, (sent, now)) in self.sent.iter_mut().zip(&sample.displacements).enumerate() {
            let steps = now.map(|x| (x / STEP_M).round() as i16);
            let is_moved =
                (0..3).any(|a| (i32::from(steps[a]) - i32::from(sent[a])).abs() >= CHANGE_MIN);
            if is_moved {
                *sent = steps;
                moved.push(i as u32);
            }
        }
        let mut change = self.header(sample, false, moved.len());
        for i in &moved {
            change.extend(i.to_le_bytes());
        }
        push_steps(&mut change, moved.iter().map(|i| &self.sent[*i as usize]));
        push_reactions(&mut change, &sample.reactions);
        let mut full = Vec::new();
        if wants_full {
            full = self.header(sample, true, self.sent.len());
            push_steps(&mut full, self.sent.iter());
            push_reactions(&mut full, &sample.reactions);
        }
        ShapeCode {
            sequence: self.sequence,
            change,
            full,
        }
    }

    fn header(&self, sample: &ShapeSample, is_full: bool, count: usize) -> Vec<u8> {
        let mut bytes = vec![KIND, u8::from(is_full)];
        bytes.extend((sample.reactions.len() as u16).to_le_bytes());
        for number in [sample.version, self.sequence, count as u32] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(STEP_M.to_le_bytes());
        bytes.extend(sample.time_us.to_le_bytes());
        bytes.extend(sample.made_ms.to_le_bytes());
        bytes
    }
}

/// Whether an encoded shape is a full one.
pub(crate) fn is_full(bytes: &[u8]) -> bool {
    bytes.get(1) == Some(&1)
}

fn push_steps<'a>(bytes: &mut Vec<u8>, steps: impl Iterator<Item = &'a [i16; 3]>) {
    for step in steps.flatten() {
        bytes.extend(step.to_le_bytes());
    }
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}

fn push_reactions(bytes: &mut Vec<u8>, reactions: &[ShownReaction]) {
    let push = |bytes: &mut Vec<u8>, v: &Vec3| {
        for x in v.iter() {
            bytes.extend((*x as f32).to_le_bytes());
        }
    };
    for reaction in reactions {
        bytes.extend(reaction.participant.to_le_bytes());
        bytes.extend((reaction.contacts.len() as u16).to_le_bytes());
        push(bytes, &reaction.force);
        push(bytes, &reaction.at);
        for contact in &reaction.contacts {
            for v in contact {
                push(bytes, v);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The displacements that a page draws after these messages, m.
    fn decode(messages: &[Vec<u8>], nodes: usize) -> Vec<[f32; 3]> {
        let mut drawn = vec![[0.0_f32; 3]; nodes];
        for m in messages {
            let count = u32::from_le_bytes(m[12..16].try_into().unwrap()) as usize;
            let is_full = m[1] == 1;
            let at = if is_full { 36 } else { 36 + 4 * count };
            for k in 0..count {
                let node = if is_full {
                    k
                } else {
                    u32::from_le_bytes(m[36 + 4 * k..40 + 4 * k].try_into().unwrap()) as usize
                };
                drawn[node] = [0, 1, 2].map(|a| {
                    let i = at + 6 * k + 2 * a;
                    f32::from(i16::from_le_bytes(m[i..i + 2].try_into().unwrap())) * STEP_M
                });
            }
        }
        drawn
    }

    #[test]
    fn changes_and_full_shapes_draw_the_same_within_25_micrometres() {
        let mut encoder = ShapeEncoder::default();
        let mut changes = Vec::new();
        for k in 0..50 {
            let shape = |i: usize| [0.0, 1e-6 * (k * i) as f32, -3e-5 * k as f32];
            let sample = ShapeSample {
                displacements: (0..40).map(shape).collect(),
                reactions: vec![ShownReaction {
                    contacts: vec![[Vec3::x(), Vec3::z()]],
                    ..Default::default()
                }],
                ..ShapeSample::default()
            };
            let code = encoder.encode(&sample, true);
            assert_eq!(code.sequence, k as u32 + 1);
            changes.push(code.change);
            let drawn = decode(&changes, 40);
            assert_eq!(drawn, decode(&[code.full], 40));
            for (drawn, is) in drawn.iter().zip(&sample.displacements) {
                assert!((0..3).all(|a| (drawn[a] - is[a]).abs() <= 2.5e-5));
            }
        }
    }

    #[test]
    fn tissue_at_rest_costs_a_header() {
        let mut encoder = ShapeEncoder::default();
        let sample = ShapeSample {
            displacements: vec![[1e-6; 3]; 1000],
            ..ShapeSample::default()
        };
        assert_eq!(encoder.encode(&sample, false).change.len(), 36);
    }

    #[test]
    fn displacements_beyond_the_range_are_clamped() {
        let mut encoder = ShapeEncoder::default();
        let sample = ShapeSample {
            displacements: vec![[10.0, f32::NAN, -10.0]],
            ..ShapeSample::default()
        };
        let full = encoder.encode(&sample, true).full;
        assert_eq!(
            decode(&[full], 1)[0],
            [32767.0 * STEP_M, 0.0, -32768.0 * STEP_M]
        );
    }
}

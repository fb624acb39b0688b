//! The check that shapes arrive in sequence: a change follows the shape that the page has, on the surface that it has.

/// Bytes before the arrays of a shape.
const SHAPE_HEADER: usize = 36;

/// Bytes of a reaction before its contact points, and of a contact point.
const REACTION: usize = 28;
const CONTACT: usize = 24;

/// A binary message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Arrived {
    /// The surface of a version of the topology.
    Surface,
    /// A shape that the page can draw.
    Shape(ArrivedShape),
    /// A shape of a surface that the page no longer draws. Shapes may wait longer than the next surface.
    Outdated,
    /// The tools.
    Tools,
    /// A message that breaks the format, or a change of a shape that the page does not have.
    Broken(&'static str),
}

/// A shape that the page can draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ArrivedShape {
    pub(crate) is_full: bool,
    /// Wall time of the solve, ms since 1970.
    pub(crate) made_ms: f64,
}

/// Surface and shape that the page has.
#[derive(Debug, Default)]
pub(crate) struct Sequence {
    /// Version and nodes of the surface.
    surface: Option<(u32, u32)>,
    /// Number of the shape.
    has: Option<u32>,
}

impl Sequence {
    /// Handles a binary message.
    pub(crate) fn note(&mut self, bytes: &[u8]) -> Arrived {
        match bytes.first() {
            Some(1) => match surface(bytes) {
                Some(surface) => {
                    self.surface = Some(surface);
                    self.has = None;
                    Arrived::Surface
                }
                None => Arrived::Broken("a surface that is not in the format"),
            },
            Some(2) => self.shape(bytes),
            Some(3) => Arrived::Tools,
            _ => Arrived::Broken("a message of an unknown kind"),
        }
    }

    fn shape(&mut self, bytes: &[u8]) -> Arrived {
        let Some((version, nodes)) = self.surface else {
            return Arrived::Broken("a shape before the surface");
        };
        let Some(shape) = Shape::parse(bytes) else {
            return Arrived::Broken("a shape that is not in the format");
        };
        if shape.version < version {
            return Arrived::Outdated;
        }
        let is_fitting = if shape.is_full {
            shape.count == nodes
        } else {
            shape.count <= nodes
        };
        if shape.version > version || !is_fitting {
            return Arrived::Broken("a shape of another surface");
        }
        let follows = self.has.map(|has| has.wrapping_add(1)) == Some(shape.number);
        if !shape.is_full && !follows {
            return Arrived::Broken("a change of a shape that the page does not have");
        }
        self.has = Some(shape.number);
        Arrived::Shape(ArrivedShape {
            is_full: shape.is_full,
            made_ms: shape.made_ms,
        })
    }
}

/// Version and number of nodes of a surface.
fn surface(bytes: &[u8]) -> Option<(u32, u32)> {
    let length = u32_at(bytes, 4)? as usize;
    let header: serde_json::Value = serde_json::from_slice(bytes.get(8..8 + length)?).ok()?;
    let number = |key: &str| u32::try_from(header[key].as_u64()?).ok();
    let (version, nodes, triangles) = (number("version")?, number("nodes")?, number("triangles")?);
    let arrays = 16 * nodes as usize + 12 * triangles as usize;
    (bytes.len() == 8 + length + arrays).then_some((version, nodes))
}

/// The header of a shape.
struct Shape {
    is_full: bool,
    version: u32,
    number: u32,
    count: u32,
    made_ms: f64,
}

impl Shape {
    fn parse(bytes: &[u8]) -> Option<Self> {
        let shape = Self {
            is_full: *bytes.get(1)? == 1,
            version: u32_at(bytes, 4)?,
            number: u32_at(bytes, 8)?,
            count: u32_at(bytes, 12)?,
            made_ms: f64::from_le_bytes(bytes.get(28..36)?.try_into().ok()?),
        };
        let count = shape.count as usize;
        let indices = if shape.is_full { 0 } else { 4 * count };
        let mut at = SHAPE_HEADER + indices + (6 * count).next_multiple_of(4);
        for _ in 0..u16_at(bytes, 2)? {
            at += REACTION + CONTACT * usize::from(u16_at(bytes, at + 2)?);
        }
        (at == bytes.len()).then_some(shape)
    }
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

#[cfg(test)]
mod tests {
    use super::{Arrived, Sequence};

    fn surface(version: u32) -> Vec<u8> {
        let mut header = format!(r#"{{"version":{version},"nodes":1,"triangles":0}}"#).into_bytes();
        header.resize(header.len().next_multiple_of(4), b' ');
        let mut bytes = vec![1, 0, 0, 0];
        bytes.extend((header.len() as u32).to_le_bytes());
        bytes.extend(header);
        bytes.extend([0; 16]);
        bytes
    }

    fn shape(version: u32, number: u32, is_full: bool) -> Vec<u8> {
        let count = u32::from(is_full);
        let mut bytes = vec![2, u8::from(is_full), 1, 0];
        for n in [version, number, count] {
            bytes.extend(n.to_le_bytes());
        }
        bytes.extend([0; 20]);
        bytes.resize(36 + 8 * count as usize, 0);
        // A reaction with one contact point.
        bytes.extend([7, 0, 1, 0]);
        bytes.extend([0; 24 + 24]);
        bytes
    }

    fn arrive(messages: &[Vec<u8>]) -> Vec<&'static str> {
        let mut sequence = Sequence::default();
        let word = |bytes: &Vec<u8>| match sequence.note(bytes) {
            Arrived::Surface => "surface",
            Arrived::Shape(_) => "shape",
            Arrived::Outdated => "outdated",
            Arrived::Tools => "tools",
            Arrived::Broken(_) => "broken",
        };
        messages.iter().map(word).collect()
    }

    #[test]
    fn change_needs_the_shape_before_it() {
        let (full, change) = (|n| shape(4, n, true), |n| shape(4, n, false));
        let all = [
            surface(4),
            full(7),
            change(8),
            change(9),
            full(12),
            change(13),
        ];
        assert_eq!(arrive(&all)[1..], ["shape"; 5]);
        assert_eq!(arrive(&[surface(4), full(7), change(9)])[2], "broken");
        assert_eq!(arrive(&[surface(4), change(1)])[1], "broken");
        assert_eq!(arrive(&[full(7)]), ["broken"]);
    }

    #[test]
    fn surface_ends_the_shapes_of_the_one_before() {
        let (old, new) = (shape(4, 8, false), shape(5, 9, true));
        let all = [surface(4), shape(4, 7, true), surface(5), old, new];
        assert_eq!(
            arrive(&all),
            ["surface", "shape", "surface", "outdated", "shape"]
        );
        assert_eq!(arrive(&[surface(4), shape(5, 1, true)])[1], "broken");
    }

    #[test]
    fn message_with_another_length_is_broken() {
        let mut short = shape(4, 7, true);
        short.pop();
        assert_eq!(arrive(&[surface(4), short])[1], "broken");
        assert_eq!(
            arrive(&[surface(4)[..20].to_vec(), vec![9], vec![]]),
            ["broken"; 3]
        );
    }
}

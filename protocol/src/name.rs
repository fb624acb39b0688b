//! Names of participants: normalised, visible and distinguishable.
//!
//! A name is normalised (NFKC, white space trimmed and collapsed). Characters that show nothing or change the order of
//! others are rejected, because with them one name can look like another. Two names of one session must differ in
//! their skeletons (Unicode Technical Standard 39, section 4) with and without regard to case.

use std::fmt;

use unicode_normalization::UnicodeNormalization as _;
use unicode_security::skeleton;

/// The longest name of a participant in bytes after normalisation. A longer one is refused.
pub const NAME_MAX_BYTES: usize = 64;

/// Maximum size of a name before normalisation in bytes, a bound on the work. A character of 2 bytes can shrink to 1.
const RAW_MAX_BYTES: usize = 4 * NAME_MAX_BYTES;

/// Characters that show nothing: `Default_Ignorable_Code_Point` (Unicode 16, `DerivedCoreProperties`), which includes
/// bidirectional controls, zero-width characters, variation selectors and fillers.
const IGNORABLE: [(u32, u32); 17] = [
    (0x00AD, 0x00AD),
    (0x034F, 0x034F),
    (0x061C, 0x061C),
    (0x115F, 0x1160),
    (0x17B4, 0x17B5),
    (0x180B, 0x180F),
    (0x200B, 0x200F),
    (0x202A, 0x202E),
    (0x2060, 0x206F),
    (0x3164, 0x3164),
    (0xFE00, 0xFE0F),
    (0xFEFF, 0xFEFF),
    (0xFFA0, 0xFFA0),
    (0xFFF0, 0xFFFB),
    (0x1BCA0, 0x1BCA3),
    (0x1D173, 0x1D17A),
    (0xE0000, 0xE0FFF),
];

/// A blank that is no white space: the Braille pattern without dots.
const BLANK: char = '\u{2800}';

/// The reason for rejecting a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// No visible character.
    #[error("the name is empty; it needs at least one visible character")]
    Empty,
    /// Too long.
    #[error("the name has {bytes} bytes; at most {NAME_MAX_BYTES} are allowed")]
    TooLong {
        /// Its size in bytes.
        bytes: usize,
    },
    /// A character that others could not see.
    #[error("the name contains {character}, which is {kind}; leave it out")]
    Character {
        /// The character.
        character: CodePoint,
        /// Its kind, with article.
        kind: &'static str,
    },
}

/// A character by its number, because it shows nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CodePoint(pub char);

impl fmt::Display for CodePoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "U+{:04X}", u32::from(self.0))
    }
}

/// The normal form of a name: NFKC without white space at its ends and with single spaces inside. Normalising the
/// result changes nothing.
pub fn normalise(name: &str) -> Result<String, NameError> {
    let bytes = name.len();
    if bytes > RAW_MAX_BYTES {
        return Err(NameError::TooLong { bytes });
    }
    check_characters(name)?;
    let composed: String = name.nfkc().collect();
    let words: Vec<&str> = composed.split_whitespace().collect();
    // Joining words can put a combining mark behind a space, which composes with nothing.
    let normal: String = words.join(" ").nfkc().collect();
    check_characters(&normal)?;
    let bytes = normal.len();
    if normal.is_empty() {
        Err(NameError::Empty)
    } else if bytes > NAME_MAX_BYTES {
        Err(NameError::TooLong { bytes })
    } else {
        Ok(normal)
    }
}

/// Whether a text has no character that shows nothing or changes the order of others. White space is visible.
pub fn is_visible(text: &str) -> bool {
    text.chars().all(|c| invisible(c).is_none())
}

fn check_characters(name: &str) -> Result<(), NameError> {
    let found = name
        .chars()
        .find_map(|c| invisible(c).map(|kind| (c, kind)));
    found.map_or(Ok(()), |(c, kind)| {
        Err(NameError::Character {
            character: CodePoint(c),
            kind,
        })
    })
}

/// The kind of a character that shows nothing; `None` for visible ones and white space.
fn invisible(c: char) -> Option<&'static str> {
    let code = u32::from(c);
    let is_ignorable = IGNORABLE
        .iter()
        .any(|(first, last)| (*first..=*last).contains(&code));
    if c.is_control() {
        Some("a control character")
    } else if matches!(code, 0x061C | 0x200E..=0x200F | 0x202A..=0x202E | 0x2066..=0x2069) {
        Some("a control of the writing direction")
    } else if is_ignorable || c == BLANK {
        Some("an invisible character")
    } else if matches!(code, 0xE000..=0xF8FF | 0xF_0000..) {
        Some("a character without a common meaning")
    } else {
        None
    }
}

/// The appearance of a name, for comparison with other names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Appearance {
    /// The skeleton, in lower case: names that look alike in any case of the skeleton.
    look: String,
    /// The skeleton of the name in lower case: names that differ in case only.
    folded: String,
}

impl Appearance {
    /// The appearance of a name.
    pub fn of(name: &str) -> Self {
        let plain = |name: &str| skeleton(name).collect::<String>();
        Self {
            look: plain(&plain(name).to_lowercase()),
            folded: plain(&name.to_lowercase()),
        }
    }

    /// Whether readers may take one name for the other.
    pub fn is_like(&self, other: &Self) -> bool {
        [&self.look, &self.folded]
            .iter()
            .any(|key| [&other.look, &other.folded].contains(key))
    }
}

/// Whether readers may take one name for the other: equal skeletons, with or without regard to case.
pub fn are_alike(a: &str, b: &str) -> bool {
    Appearance::of(a).is_like(&Appearance::of(b))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn white_space_and_compatible_forms_are_normalised() {
        for (raw, normal) in [
            ("ann", "ann"),
            ("  ann \u{a0} lee\u{3000}", "ann lee"),
            ("\u{ff41}nn", "ann"),
            ("a\u{300}nn", "\u{e0}nn"),
            ("Jürgen Müller", "Jürgen Müller"),
        ] {
            assert_eq!(normalise(raw).as_deref(), Ok(normal), "{raw:?}");
        }
    }

    #[test]
    fn invisible_characters_are_rejected_by_number() {
        for (name, number) in [
            ("ann\u{200b}", "U+200B"),
            ("ann\u{202e}", "U+202E"),
            ("a\u{2066}nn", "U+2066"),
            ("a\nn", "U+000A"),
            ("ann\u{ad}", "U+00AD"),
            ("ann\u{2800}", "U+2800"),
            ("ann\u{e0041}", "U+E0041"),
            ("ann\u{f8ff}", "U+F8FF"),
        ] {
            let error = normalise(name).unwrap_err().to_string();
            assert!(error.contains(number), "{error}");
        }
        for empty in ["", "  ", "\u{a0}\u{2003}"] {
            assert_eq!(normalise(empty), Err(NameError::Empty));
        }
        assert!(normalise(&"x".repeat(NAME_MAX_BYTES)).is_ok());
        for long in [NAME_MAX_BYTES + 1, 10 * NAME_MAX_BYTES] {
            let error = normalise(&"x".repeat(long));
            assert_eq!(error, Err(NameError::TooLong { bytes: long }));
        }
    }

    #[test]
    fn names_that_readers_confuse_are_alike() {
        for (a, b) in [
            ("ann", "Ann"),
            ("ann", "\u{430}nn"),
            ("Ian", "lan"),
            ("Ian", "ian"),
            ("IAN", "lan"),
            ("bo0", "boO"),
            ("\u{412}ob", "Bob"),
        ] {
            assert!(are_alike(a, b) && are_alike(b, a), "{a} {b}");
        }
        for (a, b) in [("ann", "anna"), ("ian", "lan"), ("p1", "p2")] {
            assert!(!are_alike(a, b), "{a} {b}");
        }
    }

    proptest! {
        #[test]
        fn normalising_twice_changes_nothing(name in any::<String>()) {
            if let Ok(normal) = normalise(&name) {
                prop_assert_eq!(normalise(&normal), Ok(normal));
            }
        }

        #[test]
        fn accepted_names_show_every_character(name in "[a-z\u{200b}-\u{200f}\u{202a}-\u{202e}\u{2060}-\u{2069} \u{a0}\t]{0,12}") {
            if let Ok(normal) = normalise(&name) {
                prop_assert!(normal.chars().all(|c| c == ' ' || c.is_ascii_lowercase()));
                prop_assert_eq!(normal.trim(), &normal);
            }
        }

        #[test]
        fn names_that_are_not_alike_have_different_skeletons(a in "[A-Za-z0-9\u{410}-\u{44f}]{1,4}", b in "[A-Za-z0-9\u{410}-\u{44f}]{1,4}") {
            if !are_alike(&a, &b) {
                let plain = |name: &str| skeleton(name).collect::<String>();
                prop_assert_ne!(plain(&a), plain(&b));
                prop_assert_ne!(a.to_lowercase(), b.to_lowercase());
            }
        }
    }
}

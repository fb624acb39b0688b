//! Devices that are plugged in, and which of them is meant.

use std::fmt;

use thiserror::Error;

/// A device that a driver sees.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// What tells it from others of its kind: `haply:049D` means the one with the id `049D`.
    pub id: String,
    /// What it calls itself.
    pub name: String,
    /// Whether it can be opened, as far as that is known; another program may use it.
    pub is_free: bool,
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.id, self.name)
    }
}

/// Why it is not clear which device is meant.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Choice {
    /// None is plugged in.
    #[error("no device of the kind {kind} is plugged in: {hint}")]
    None {
        /// The driver's word.
        kind: &'static str,
        /// What to look at.
        hint: &'static str,
    },
    /// There are several.
    #[error("{} devices of the kind {kind} are plugged in: {}; say which, as in {kind}:{}", found.len(),
            list(found), found[0].id)]
    Several {
        /// The driver's word.
        kind: &'static str,
        /// All of them; never empty.
        found: Vec<Found>,
    },
    /// There are others.
    #[error("no device {kind}:{which} is plugged in; there is {}", list(found))]
    NoSuch {
        /// The driver's word.
        kind: &'static str,
        /// What was asked for.
        which: String,
        /// What there is; never empty.
        found: Vec<Found>,
    },
    /// Two have the same id.
    #[error("{count} devices of the kind {kind} have the id {which}; unplug all but one")]
    Alike {
        /// The driver's word.
        kind: &'static str,
        /// What was asked for.
        which: String,
        /// How many.
        count: usize,
    },
}

fn list(found: &[Found]) -> String {
    let all: Vec<String> = found.iter().map(Found::to_string).collect();
    all.join(", ")
}

/// The place in `found` of the device that is meant: without an id the only one, or the only one that is free. Where
/// there is but one and it is not free, it is meant all the same, and opening it says why it is not.
pub(super) fn choose(
    kind: &'static str,
    hint: &'static str,
    found: &[Found],
    which: Option<&str>,
) -> Result<usize, Choice> {
    let is_any_free = found.iter().any(|f| f.is_free);
    let fits = |f: &Found| match which {
        Some(which) => f.id.eq_ignore_ascii_case(which),
        None => f.is_free || !is_any_free,
    };
    let places: Vec<usize> = (0..found.len()).filter(|&i| fits(&found[i])).collect();
    match (places.as_slice(), which) {
        ([one], _) => Ok(*one),
        (_, _) if found.is_empty() => Err(Choice::None { kind, hint }),
        ([], which) => Err(Choice::NoSuch {
            kind,
            which: which.unwrap_or_default().to_owned(),
            found: found.to_vec(),
        }),
        (many, Some(which)) => Err(Choice::Alike {
            kind,
            which: which.to_owned(),
            count: many.len(),
        }),
        (_, None) => Err(Choice::Several {
            kind,
            found: found.to_vec(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::{Choice, Found, choose};

    fn found(ids: &[&str]) -> Vec<Found> {
        let one = |id: &&str| Found {
            id: (*id).to_owned(),
            name: "Inverse3".to_owned(),
            is_free: true,
        };
        ids.iter().map(one).collect()
    }

    #[test]
    fn a_choice_is_made_only_where_there_is_no_doubt() {
        let pick = |ids: &[&str], which| choose("haply", "look", &found(ids), which);
        assert_eq!(pick(&["049D"], None), Ok(0));
        assert_eq!(pick(&["049D", "04BA"], Some("04ba")), Ok(1));
        assert!(matches!(pick(&[], None), Err(Choice::None { .. })));
        assert!(matches!(pick(&[], Some("1")), Err(Choice::None { .. })));
        let twice = pick(&["049D", "049D"], Some("049D")).unwrap_err();
        assert!(matches!(twice, Choice::Alike { count: 2, .. }));
    }

    #[test]
    fn the_only_free_one_is_meant_and_the_only_one_even_where_it_is_not_free() {
        let pick = |free: &[bool], which| {
            let mut all = found(&["0", "1", "2"][..free.len()]);
            for (device, is_free) in all.iter_mut().zip(free) {
                device.is_free = *is_free;
            }
            choose("dhd", "look", &all, which)
        };
        assert_eq!(pick(&[false, true], None), Ok(1));
        assert_eq!(pick(&[false], None), Ok(0));
        assert_eq!(pick(&[false, true], Some("0")), Ok(0));
        for doubtful in [&[false, false][..], &[true, false, true]] {
            let several = pick(doubtful, None);
            assert!(matches!(several, Err(Choice::Several { .. })));
        }
    }

    #[test]
    fn doubts_are_said_with_all_devices_and_the_words_to_type() {
        let all = found(&["049D", "04BA"]);
        let several = choose("haply", "look", &all, None).unwrap_err().to_string();
        assert!(
            several.contains("049D (Inverse3), 04BA (Inverse3)"),
            "{several}"
        );
        assert!(several.contains("as in haply:049D"), "{several}");
        let other = choose("haply", "look", &all, Some("7"))
            .unwrap_err()
            .to_string();
        assert!(
            other.contains("haply:7") && other.contains("04BA"),
            "{other}"
        );
    }
}

//! Plugged-in devices, and the choice of one of them.

use std::fmt;

use thiserror::Error;

/// A device that a driver has found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Identifier among the devices of its kind: `haply:049D` selects the one with the id `049D`.
    pub id: String,
    /// The device's own name.
    pub name: String,
    /// Whether it can be opened, as far as known; another program may use it.
    pub is_free: bool,
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.id, self.name)
    }
}

/// Reason why the choice of a device fails.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SelectionError {
    /// No device is plugged in.
    #[error("no device of the kind {kind} is plugged in: {hint}")]
    None {
        /// The driver's name.
        kind: &'static str,
        /// Remedy.
        hint: &'static str,
    },
    /// Several devices are plugged in.
    #[error("{} devices of the kind {kind} are plugged in: {}; choose one, as in {kind}:{}", found.len(),
            list(found), found[0].id)]
    Several {
        /// The driver's name.
        kind: &'static str,
        /// All of them; never empty.
        found: Vec<Found>,
    },
    /// The requested device is not plugged in, but others are.
    #[error("no device {kind}:{which} is plugged in; there is {}", list(found))]
    NoSuch {
        /// The driver's name.
        kind: &'static str,
        /// The requested id.
        which: String,
        /// The devices found; never empty.
        found: Vec<Found>,
    },
    /// Two devices have the same id.
    #[error("{count} devices of the kind {kind} have the id {which}; unplug all but one")]
    Alike {
        /// The driver's name.
        kind: &'static str,
        /// The requested id.
        which: String,
        /// How many.
        count: usize,
    },
}

fn list(found: &[Found]) -> String {
    let all: Vec<String> = found.iter().map(Found::to_string).collect();
    all.join(", ")
}

/// Index in `found` of the selected device: without an id, the only device, or the only free one. A single device
/// that is not free is still selected, so that opening it reports the reason.
pub(super) fn choose(
    kind: &'static str,
    hint: &'static str,
    found: &[Found],
    which: Option<&str>,
) -> Result<usize, SelectionError> {
    let is_any_free = found.iter().any(|f| f.is_free);
    let fits = |f: &Found| match which {
        Some(which) => f.id.eq_ignore_ascii_case(which),
        None => f.is_free || !is_any_free,
    };
    let places: Vec<usize> = (0..found.len()).filter(|&i| fits(&found[i])).collect();
    match (places.as_slice(), which) {
        ([one], _) => Ok(*one),
        (_, _) if found.is_empty() => Err(SelectionError::None { kind, hint }),
        ([], which) => Err(SelectionError::NoSuch {
            kind,
            which: which.unwrap_or_default().to_owned(),
            found: found.to_vec(),
        }),
        (many, Some(which)) => Err(SelectionError::Alike {
            kind,
            which: which.to_owned(),
            count: many.len(),
        }),
        (_, None) => Err(SelectionError::Several {
            kind,
            found: found.to_vec(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::{Found, SelectionError, choose};

    fn found(ids: &[&str]) -> Vec<Found> {
        let one = |id: &&str| Found {
            id: (*id).to_owned(),
            name: "Inverse3".to_owned(),
            is_free: true,
        };
        ids.iter().map(one).collect()
    }

    #[test]
    fn only_an_unambiguous_choice_succeeds() {
        let pick = |ids: &[&str], which| choose("haply", "look", &found(ids), which);
        assert_eq!(pick(&["049D"], None), Ok(0));
        assert_eq!(pick(&["049D", "04BA"], Some("04ba")), Ok(1));
        assert!(matches!(pick(&[], None), Err(SelectionError::None { .. })));
        assert!(matches!(
            pick(&[], Some("1")),
            Err(SelectionError::None { .. })
        ));
        let twice = pick(&["049D", "049D"], Some("049D")).unwrap_err();
        assert!(matches!(twice, SelectionError::Alike { count: 2, .. }));
    }

    #[test]
    fn the_only_free_device_or_the_only_device_is_selected() {
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
            assert!(matches!(several, Err(SelectionError::Several { .. })));
        }
    }

    #[test]
    fn an_ambiguous_choice_lists_all_devices_and_the_syntax() {
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

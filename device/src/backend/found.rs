//! Plugged-in devices, and the choice of one of them.

use std::fmt;

use crate::OpenError;

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

fn list(found: &[Found]) -> String {
    let all: Vec<String> = found.iter().map(Found::to_string).collect();
    all.join(", ")
}

/// Index in `found` of the selected device: without an id, the only device, or the only free one. A single device
/// that is not free is still selected, so that opening it reports the reason.
pub(super) fn choose(
    kind: &str,
    hint: &str,
    found: &[Found],
    which: Option<&str>,
) -> Result<usize, OpenError> {
    let is_any_free = found.iter().any(|f| f.is_free);
    let fits = |f: &Found| match which {
        Some(which) => f.id.eq_ignore_ascii_case(which),
        None => f.is_free || !is_any_free,
    };
    let places: Vec<usize> = (0..found.len()).filter(|&i| fits(&found[i])).collect();
    let all = list(found);
    Err(OpenError::new(match (places.as_slice(), which) {
        ([one], _) => return Ok(*one),
        _ if found.is_empty() => format!("no device of the kind {kind} is plugged in: {hint}"),
        ([], which) => {
            let which = which.unwrap_or_default();
            format!("no device {kind}:{which} is plugged in; there is {all}")
        }
        (many, Some(which)) => format!(
            "{} devices of the kind {kind} have the id {which}; unplug all but one",
            many.len()
        ),
        (_, None) => format!(
            "{} devices of the kind {kind} are plugged in: {all}; choose one, as in {kind}:{}",
            found.len(),
            found[0].id
        ),
    }))
}

#[cfg(test)]
mod tests {
    use super::{Found, choose};

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
        for (ids, which, why) in [
            (&[][..], None, "is plugged in: look"),
            (&[], Some("1"), "is plugged in: look"),
            (&["049D", "049D"], Some("049D"), "2 devices of the kind"),
        ] {
            let said = pick(ids, which).unwrap_err().to_string();
            assert!(said.contains(why), "{said}");
        }
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
            assert!(several.unwrap_err().to_string().contains("choose one"));
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

//! Device argument of the command line: a kind, and an optional device id.

use std::str::FromStr;

use clap::ValueEnum;

use super::DeviceKind;

/// `haply`, or `haply:049D` where there are several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct DeviceSelection {
    pub(crate) kind: DeviceKind,
    /// Device id as listed by `devices`.
    pub(crate) which: Option<String>,
}

impl FromStr for DeviceSelection {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (word, which) = match text.split_once(':') {
            Some((word, which)) => (word, Some(which.trim())),
            None => (text, None),
        };
        let kind = DeviceKind::from_str(word, false).map_err(|_| {
            let words: Vec<&str> = DeviceKind::ALL.iter().map(|(k, _)| k.word()).collect();
            format!(
                "unknown device `{word}`; known devices: auto, {}",
                words.join(", ")
            )
        })?;
        match which {
            Some(_) if !kind.is_owned() => {
                Err(format!("{word} takes no device id; remove \":ID\""))
            }
            Some("") => Err(format!(
                "empty device id after \"{word}:\"; use an id listed by `palpate-client devices`"
            )),
            which => Ok(Self {
                kind,
                which: which.map(str::to_owned),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{DeviceKind, DeviceSelection};

    #[test]
    fn choice_is_kind_and_optional_id() {
        let parsed = |text: &str| text.parse::<DeviceSelection>();
        let haply = |which: Option<&str>| DeviceSelection {
            kind: DeviceKind::Haply,
            which: which.map(str::to_owned),
        };
        assert_eq!(parsed("haply"), Ok(haply(None)));
        assert_eq!(parsed("haply:049D"), Ok(haply(Some("049D"))));
        let named = parsed("openhaptics:Left Device").unwrap();
        assert_eq!(named.which.as_deref(), Some("Left Device"));
        assert!(parsed("haply:").unwrap_err().contains("empty device id"));
        assert!(parsed("sim:1").unwrap_err().contains("no device id"));
        assert!(parsed("gamepad:1").unwrap_err().contains("no device id"));
        let unknown = parsed("joystick").unwrap_err();
        assert!(
            unknown.contains("openhaptics") && unknown.contains("auto"),
            "{unknown}"
        );
    }
}

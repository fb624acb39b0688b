//! A device as it is written on the command line: a kind, and which of several.

use std::str::FromStr;

use clap::ValueEnum;

use super::DeviceKind;

/// `haply`, or `haply:049D` where there are several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct DeviceChoice {
    pub(crate) kind: DeviceKind,
    /// As `devices` lists it.
    pub(crate) which: Option<String>,
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (word, which) = match text.split_once(':') {
            Some((word, which)) => (word, Some(which.trim())),
            None => (text, None),
        };
        let kind = DeviceKind::from_str(word, false).map_err(|_| {
            let words: Vec<&str> = DeviceKind::ALL.iter().map(|(k, _)| k.word()).collect();
            format!(
                "there is no device {word}; there are auto, {}",
                words.join(", ")
            )
        })?;
        match which {
            Some(_) if kind.is_steered() => Err(format!(
                "of {word} the first that is connected is taken; leave out what follows the colon"
            )),
            Some(_) if !kind.is_owned() => Err(format!(
                "of {word} there is one; leave out what follows the colon"
            )),
            Some("") => Err(format!(
                "which {word} is meant stands after the colon, as `devices` lists it"
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
    use super::{DeviceChoice, DeviceKind};

    #[test]
    fn a_choice_is_a_kind_and_which_of_several() {
        let parsed = |text: &str| text.parse::<DeviceChoice>();
        let haply = |which: Option<&str>| DeviceChoice {
            kind: DeviceKind::Haply,
            which: which.map(str::to_owned),
        };
        assert_eq!(parsed("haply"), Ok(haply(None)));
        assert_eq!(parsed("haply:049D"), Ok(haply(Some("049D"))));
        let named = parsed("openhaptics:Left Device").unwrap();
        assert_eq!(named.which.as_deref(), Some("Left Device"));
        assert!(parsed("haply:").unwrap_err().contains("after the colon"));
        assert!(parsed("sim:1").unwrap_err().contains("there is one"));
        assert!(parsed("gamepad:1").unwrap_err().contains("the first"));
        let unknown = parsed("joystick").unwrap_err();
        assert!(
            unknown.contains("openhaptics") && unknown.contains("auto"),
            "{unknown}"
        );
    }
}

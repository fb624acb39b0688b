//! Options of `palpate-server host`.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use clap::Args;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_room::SEATS_MAX;

use super::IdentitySource;
use crate::ServerError;

/// Initial delay of adaptive compensation, enough for a local network. D grows by 250 ms per second and shrinks by
/// 20 ms per second: a low start reaches 150 ms within a second, a high one would stay for seconds.
const INITIAL_DELAY_US: u32 = 10_000;

/// Maximum delay of any compensation, in ms; collaboration fails beyond a second.
const DELAY_MAX_MS: u32 = 1000;

/// Default ticks per second: fast enough for the eye, and twice the period of a 60 Hz screen for a solve with many
/// tools.
pub const TICK_HZ: u32 = 30;

/// The options of `palpate-server host`.
#[derive(Debug, Clone, Args)]
pub(crate) struct HostOptions {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    pub(super) model: String,
    /// Address and UDP port to listen on, or a port alone for all addresses; port 0 takes any free one
    #[arg(long, value_name = "[ADDRESS:]PORT", default_value = "0.0.0.0:4433", value_parser = parse_listen)]
    pub(super) listen: SocketAddr,
    /// Folder of the host's certificate, its key and the secrets of the links, or new for a temporary identity
    /// [default: `$XDG_STATE_HOME/palpate/host` or `~/.local/state/palpate/host`]
    #[arg(long, value_name = "DIR|new")]
    pub(super) identity: Option<IdentitySource>,
    /// Keep the cuts in this file, and continue with those that it has
    #[arg(long, value_name = "FILE")]
    pub(super) session: Option<PathBuf>,
    /// Make new join links and invalidate the old ones
    #[arg(long)]
    pub(super) new_links: bool,
    /// Host name or address to put into the join links [default: this machine's]
    #[arg(long, value_name = "HOST")]
    pub(super) public: Option<String>,
    /// Ticks per second of the authoritative tissue and of all views
    #[arg(long, default_value_t = TICK_HZ, value_name = "HZ")]
    pub(super) tick_hz: u32,
    /// Artificial time compensation: adaptive, fixed:MS or none
    #[arg(long, default_value = "adaptive", value_name = "MODE")]
    pub(super) compensation: String,
    /// Maximum adaptive delay in ms (uplink plus downlink)
    #[arg(long, default_value_t = 400, value_name = "MS")]
    pub(super) delay_cap: u32,
    /// Seats in the session, including spectators: 1 to 64; of more than two, one is for an instructor
    #[arg(long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(1..=i64::from(SEATS_MAX)))]
    pub(super) seats: u16,
    /// Seats that spectators and recorders may take together [default: half of the seats]
    #[arg(long, value_name = "M")]
    spectators: Option<u16>,
    /// Start scripts of clients with `--at session` once N tools have joined
    #[arg(long, default_value_t = 1, value_name = "N")]
    pub(super) start_when: u16,
    /// Serve the session as a web page, for participants with a browser and for the instructor's console
    #[arg(long, value_name = "[ADDRESS:]PORT", num_args = 0..=1, default_missing_value = palpate_view::SERVER_VIEW, value_parser = palpate_view::parse_view)]
    pub(super) view: Option<SocketAddr>,
    /// Serve the page by HTTPS with this certificate chain (PEM). Without it, addresses of other machines get a
    /// self-signed certificate, and 127.0.0.1 plain HTTP
    #[arg(long, value_name = "FILE", requires_all = ["view", "key"])]
    pub(super) certificate: Option<PathBuf>,
    /// The private key of --certificate (PEM)
    #[arg(long, value_name = "FILE", requires = "certificate")]
    pub(super) key: Option<PathBuf>,
    /// End after S seconds
    #[arg(long, value_name = "S")]
    pub(super) duration: Option<f64>,
    /// Print one JSON object when listening and one at the end
    #[arg(long)]
    pub(super) json: bool,
}

impl HostOptions {
    /// Seats that spectators and recorders may take together.
    pub(super) fn spectators(&self) -> u16 {
        let half = if self.seats > 2 {
            self.seats / 2
        } else {
            // Two trainees or one of each.
            self.seats - 1
        };
        self.spectators.unwrap_or(half)
    }

    /// Checks the options that depend on one another. Returns the time compensation.
    pub(super) fn check(&self) -> Result<CompensationSettings, ServerError> {
        let bad = |sentence: String| Err(ServerError::CommandLine(sentence));
        if !(1..=500).contains(&self.tick_hz) {
            return bad(format!(
                "--tick-hz {} is not between 1 and 500",
                self.tick_hz
            ));
        }
        if self.duration.is_some_and(|s| !(s.is_finite() && s > 0.0)) {
            return bad("--duration must be a number of seconds above 0".into());
        }
        if self.spectators() > self.seats {
            return bad(format!(
                "--spectators {} is more than there are seats ({})",
                self.spectators(),
                self.seats
            ));
        }
        if self.start_when > self.seats {
            return bad(format!(
                "--start-when {} waits for more tools than there are seats ({})",
                self.start_when, self.seats
            ));
        }
        parse_compensation(&self.compensation, self.delay_cap)
    }
}

/// The port when none is given.
const PORT: u16 = 4433;

/// Reads an address and a port, a port alone (`4433` or `:4433`: all addresses of this machine), or an address alone.
fn parse_listen(text: &str) -> Result<SocketAddr, String> {
    let everywhere = IpAddr::V4(Ipv4Addr::UNSPECIFIED);
    let bare = text
        .strip_prefix('[')
        .and_then(|rest| rest.strip_suffix(']'));
    if let Ok(port) = text.strip_prefix(':').unwrap_or(text).parse() {
        Ok(SocketAddr::new(everywhere, port))
    } else if let Ok(ip) = bare.unwrap_or(text).parse() {
        Ok(SocketAddr::new(ip, PORT))
    } else {
        text.parse().map_err(|_| {
            "give ADDRESS:PORT with an address of this machine (0.0.0.0:4433, [::]:4433), or a port alone (4433)".to_owned()
        })
    }
}

/// Reads `adaptive`, `fixed:MS` or `none`.
fn parse_compensation(text: &str, cap_ms: u32) -> Result<CompensationSettings, ServerError> {
    let bad = |why: String| Err(ServerError::CommandLine(why));
    if cap_ms > DELAY_MAX_MS {
        return bad(format!(
            "--delay-cap {cap_ms} is above the limit of {DELAY_MAX_MS} ms"
        ));
    }
    match text.split_once(':') {
        None if text == "none" => Ok(CompensationSettings {
            mode: CompensationMode::None,
            initial_delay_us: 0,
        }),
        None if text == "adaptive" && cap_ms == 0 => bad(
            "--delay-cap 0 leaves adaptive compensation no delay: give at least 1 ms, or --compensation none".into(),
        ),
        None if text == "adaptive" => {
            let cap_us = cap_ms * 1000;
            let mode = CompensationMode::Adaptive { cap_us };
            Ok(CompensationSettings {
                mode,
                initial_delay_us: INITIAL_DELAY_US.min(cap_us),
            })
        }
        Some(("fixed", ms)) => match ms.parse::<u32>() {
            Ok(ms) if ms <= DELAY_MAX_MS => Ok(CompensationSettings {
                mode: CompensationMode::Fixed,
                initial_delay_us: ms * 1000,
            }),
            _ => bad(format!(
                "fixed:{ms} is not a delay of 0 to {DELAY_MAX_MS} ms"
            )),
        },
        _ => bad(format!(
            "--compensation {text:?} is unknown; it is adaptive, fixed:MS (such as fixed:100) or none"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_or_address_alone_is_accepted() {
        for (text, address) in [
            ("4433", "0.0.0.0:4433"),
            (":5000", "0.0.0.0:5000"),
            ("0", "0.0.0.0:0"),
            ("127.0.0.1", "127.0.0.1:4433"),
            ("127.0.0.1:1", "127.0.0.1:1"),
            ("::1", "[::1]:4433"),
            ("[::]", "[::]:4433"),
            ("[::]:9", "[::]:9"),
        ] {
            assert_eq!(parse_listen(text), Ok(address.parse().unwrap()), "{text}");
        }
        for text in ["", ":", "70000", "localhost", "1.2.3.4:", "-1", "[::"] {
            assert!(
                parse_listen(text).unwrap_err().contains("0.0.0.0:4433"),
                "{text}"
            );
        }
    }

    #[test]
    fn every_mode_parses_and_invalid_ones_are_rejected() {
        let adaptive = parse_compensation("adaptive", 200).unwrap();
        assert_eq!(
            adaptive.mode,
            CompensationMode::Adaptive { cap_us: 200_000 }
        );
        let fixed = parse_compensation("fixed:100", 200).unwrap();
        assert_eq!(
            (fixed.mode, fixed.initial_delay_us),
            (CompensationMode::Fixed, 100_000)
        );
        assert_eq!(
            parse_compensation("none", 200).unwrap().mode,
            CompensationMode::None
        );
        for text in ["fixed", "fixed:", "fixed:-3", "fixed:9999", "magic", ""] {
            assert!(parse_compensation(text, 200).is_err(), "{text}");
        }
        assert!(parse_compensation("adaptive", 100_000).is_err());
        assert!(parse_compensation("adaptive", 0).is_err());
        assert!(parse_compensation("none", 0).is_ok());
    }
}

//! `palpate-lab relay`.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use clap::Args;

use super::Relay;
use crate::cli::print_line;
use crate::network::Profile;
use crate::progress::Interrupt;

/// Arguments of `relay`.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Address for clients; port 0 takes any free one
    #[arg(long, value_name = "ADDRESS")]
    listen: SocketAddr,
    /// Address of the server
    #[arg(long, value_name = "ADDRESS")]
    to: SocketAddr,
    /// The emulated network: a name, or a TOML file
    #[arg(long, default_value = "transatlantic", value_parser = Profile::parse)]
    profile: Profile,
    /// Seed of the packet fates
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Length of the run in seconds; without it, until Ctrl-C
    #[arg(long, value_name = "S")]
    duration: Option<f64>,
    /// Period of address changes in seconds: the server sees every client at a new address, as after a NAT
    /// rebinding
    #[arg(long, value_name = "S")]
    rebind_every: Option<f64>,
    /// Print one JSON object when listening and one with the figures at the end
    #[arg(long)]
    json: bool,
}

fn seconds(name: &str, given: Option<f64>) -> Result<Option<Duration>, String> {
    match given {
        Some(s) if !(1e-3..1e9).contains(&s) => Err(format!(
            "{name} {s} must be a number of seconds from 0.001 to a billion"
        )),
        given => Ok(given.map(Duration::from_secs_f64)),
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<bool, String> {
    let duration = seconds("--duration", arguments.duration)?;
    let rebind_every = seconds("--rebind-every", arguments.rebind_every)?;
    let interrupt = Interrupt::listen()?;
    let profile = arguments.profile.clone();
    let relay = Relay::start(arguments.listen, arguments.to, profile, arguments.seed)
        .map_err(|e| format!("cannot listen on {}: {e}", arguments.listen))?;
    if arguments.json {
        print_line(&serde_json::json!({ "listening": relay.local_addr() }).to_string())?;
    } else {
        print_line(&format!(
            "network {} with seed {}: {} to {}; end with Ctrl-C",
            arguments.profile.name,
            arguments.seed,
            relay.local_addr(),
            arguments.to
        ))?;
    }
    let began = Instant::now();
    let mut rebound = began;
    while !interrupt.is_set() && duration.is_none_or(|d| began.elapsed() < d) {
        std::thread::sleep(Duration::from_millis(20));
        if rebind_every.is_some_and(|period| rebound.elapsed() >= period) {
            rebound = Instant::now();
            let clients = relay.stats().clients;
            for flow in 0..clients as usize {
                relay.rebind(flow)?;
            }
        }
    }
    let s = relay.stats();
    if arguments.json {
        print_line(&serde_json::to_string(&s).expect("figures are plain data"))?;
    } else {
        print_line(&format!(
            "{} packets from {} client(s) and back: {} dropped ({:.2} %; {} of them in outages, {} at the \
             bottleneck), {} doubled, {} with flipped bits, {} overtook; delay {:.1} ms mean, {:.1} ms p99; \
             {} new addresses; {} found no room",
            s.total.sent,
            s.clients,
            s.total.dropped,
            s.loss * 100.0,
            s.total.in_outage,
            s.total.queue_full,
            s.total.duplicated,
            s.total.corrupted,
            s.total.reordered,
            s.delay_mean_ms,
            s.delay_p99_ms,
            s.rebinds,
            s.overflowed
        ))?;
        for (name, way) in [("up", &s.up), ("down", &s.down)] {
            print_line(&format!("  {name:<5}{way}"))?;
        }
    }
    Ok(true)
}

//! `palpate-lab profiles`.

use clap::Args;

use super::{Jitter, Link, Profile};
use crate::cli::print_line;

pub(crate) const HELP: &str = "\
Examples:
  palpate-lab profiles
  palpate-lab profiles wifi-bursts > mine.toml
  palpate-lab demo --profile mine.toml

Every key of a profile file; [up] (to the server) and [down] override [both]:

  name = \"mine\"
  [both]
  delay_ms = 40.0
  reorder = true             # a packet with less delay overtakes an earlier one
  loss = 0.01                # shares of packets, 0 to 1
  duplicate = 0.001
  corrupt = 0.001            # flipped bits
  jitter = { kind = \"gamma\", mean_ms = 8.0, deviation_ms = 4.0 }
    # or { kind = \"uniform\", reach_ms = 5.0 }, { kind = \"normal\", deviation_ms = 2.0 },
    # { kind = \"pareto\", scale_ms = 2.0, exponent = 2.5 }
  bursts = { good_packets = 480, bad_packets = 20, loss = 0.4, delay_ms = 60.0 }  # Gilbert and Elliott
  rate = { bits_per_s = 10e6, queue_bytes = 65536 }                               # drop-tail queue
  steps = { repeat_s = 20.0, delays = [{ at_s = 0.0, delay_ms = 30.0 }, { at_s = 10.0, delay_ms = 80.0 }] }
  outages = { repeat_s = 60.0, times = [{ from_s = 5.0, to_s = 5.5 }] }           # the link is down
  [up]
  trace = \"recorded.csv\"     # time_ms,delay_ms,lost; repeats; added to the rest
  trace_offset_s = 12.0      # where the session begins in it; by default at a random time";

/// Arguments of `profiles`.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// The profile to print as TOML: a name, or a file to check
    name: Option<String>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<bool, String> {
    if let Some(name) = &arguments.name {
        let profile = Profile::parse(name)?;
        print_line(profile.to_toml().trim_end())?;
        return Ok(true);
    }
    for name in Profile::names() {
        let profile = Profile::named(name)?;
        print_line(&format!("{name:17} {}", sentence(&profile.up)))?;
    }
    for file in Profile::recorded() {
        let name = file.file_stem().unwrap_or_default().to_string_lossy();
        print_line(&format!("{name:17} recorded, in PALPATE_DATA"))?;
    }
    Ok(true)
}

fn sentence(link: &Link) -> String {
    let mut words = vec![match &link.steps {
        Some(steps) => {
            let delays: Vec<String> = steps
                .delays
                .iter()
                .map(|s| s.delay_ms.to_string())
                .collect();
            format!("{} ms one way by turns", delays.join(", "))
        }
        None => format!("{} ms one way", link.delay_ms),
    }];
    match link.jitter {
        Jitter::None => {}
        Jitter::Uniform { reach_ms } => words.push(format!("±{reach_ms} ms")),
        Jitter::Normal { deviation_ms } => words.push(format!("σ {deviation_ms} ms")),
        Jitter::Gamma { mean_ms, .. } => words.push(format!("mean jitter {mean_ms} ms")),
        Jitter::Pareto { scale_ms, .. } => words.push(format!("a tail of {scale_ms} ms")),
    }
    if link.reorder {
        words.push("out of order".to_owned());
    }
    if link.loss > 0.0 {
        words.push(format!("{} % lost", link.loss * 100.0));
    }
    if let Some(bursts) = link.bursts {
        words.push(format!(
            "bursts of {} packets with {} ms more delay and {} % loss",
            bursts.bad_packets,
            bursts.delay_ms,
            bursts.loss * 100.0
        ));
    }
    if let Some(outages) = &link.outages {
        let down_s: f64 = outages.times.iter().map(|o| o.to_s - o.from_s).sum();
        words.push(match outages.repeat_s {
            Some(period) => format!("down for {down_s} s in every {period} s"),
            None => format!("down for {down_s} s"),
        });
    }
    if link.duplicate > 0.0 {
        words.push(format!("{} % doubled", link.duplicate * 100.0));
    }
    words.join(", ")
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn the_file_in_the_help_is_a_profile() {
        let from = HELP.find("  name =").unwrap();
        let dir = tempfile::tempdir().unwrap();
        let trace = "time_ms,delay_ms,lost\n0,10,0\n20,,1\n";
        std::fs::write(dir.path().join("recorded.csv"), trace).unwrap();
        let path = dir.path().join(Path::new("mine.toml"));
        let profile = Profile::from_toml(&HELP[from..], &path).unwrap();
        assert!(profile.up.trace.is_some() && profile.down.trace.is_none());
        assert!(profile.down.rate.is_some() && profile.down.outages.is_some());
    }
}

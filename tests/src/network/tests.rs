//! Laws of the emulator, measured on packets in virtual time.

use std::collections::BTreeSet;
use std::path::Path as File;

use proptest::prelude::*;

use super::*;

/// Packets per measurement.
const PACKETS: usize = 10_000;

/// Critical value of Kolmogorov's statistic times √n at a significance of 0.001 (Kolmogorov 1933).
const KOLMOGOROV: f64 = 1.949;

/// Maximum deviation of a count in standard deviations; one of 15,000 correct samples exceeds it.
const SIGMAS: f64 = 4.0;

/// A path with the same link in both directions.
fn path(link: Link, seed: u64) -> Path {
    Path::new(&Profile::both("measured", link), seed, 3, Direction::Up)
}

/// Delays in ms of packets sent every 20 ms, without lost packets.
fn delays_ms(link: Link, seed: u64) -> Vec<f64> {
    let mut path = path(link, seed);
    (0..PACKETS as u64)
        .map(|n| n * 20_000)
        .flat_map(|at| path.send(at, 100).into_iter().map(move |a| (at, a.at_us)))
        .map(|(at, arrives)| (arrives - at) as f64 * 1e-3)
        .collect()
}

/// Maximum distance between the sample distribution and the requested one, times √n.
fn kolmogorov(mut sample: Vec<f64>, cdf: impl Fn(f64) -> f64) -> f64 {
    sample.sort_by(f64::total_cmp);
    let n = sample.len() as f64;
    let distance = sample.iter().enumerate().map(|(i, x)| {
        let p = cdf(*x);
        (p - i as f64 / n).abs().max((p - (i + 1) as f64 / n).abs())
    });
    distance.fold(0.0, f64::max) * n.sqrt()
}

/// Cumulative distribution of a density by Simpson's rule on a fine grid, independent of the emulator's
/// sampling.
fn distribution(density: impl Fn(f64) -> f64, from: f64, to: f64) -> impl Fn(f64) -> f64 {
    const CELLS: usize = 20_000;
    let h = (to - from) / CELLS as f64;
    let mut sums = vec![0.0];
    for i in 0..CELLS {
        let x = from + i as f64 * h;
        let part = h / 6.0 * (density(x) + 4.0 * density(x + h / 2.0) + density(x + h));
        sums.push(sums[i] + part);
    }
    move |x| {
        let at = ((x - from) / h).clamp(0.0, CELLS as f64);
        let i = (at as usize).min(CELLS - 1);
        let sum = sums[i] + (at - i as f64) * (sums[i + 1] - sums[i]);
        sum / sums[CELLS]
    }
}

/// A reordering link: packets do not wait for earlier ones.
fn free(delay_ms: f64, jitter: Jitter) -> Link {
    Link {
        delay_ms,
        jitter,
        reorder: true,
        ..Link::default()
    }
}

fn assert_distributed(name: &str, link: &Link, cdf: impl Fn(f64) -> f64) {
    for seed in [1, 2, 3] {
        let distance = kolmogorov(delays_ms(link.clone(), seed), &cdf);
        assert!(distance < KOLMOGOROV, "{name}, seed {seed}: {distance}");
    }
    // A distribution shifted by 0.3 ms is detected, so the test can fail.
    let off = kolmogorov(delays_ms(link.clone(), 1), |x| cdf(x - 0.3));
    assert!(
        off > KOLMOGOROV,
        "{name}: a shifted distribution is not detected: {off}"
    );
}

#[test]
fn uniform_delays_follow_their_distribution() {
    let link = free(20.0, Jitter::Uniform { reach_ms: 5.0 });
    assert_distributed("uniform", &link, |x| ((x - 15.0) / 10.0).clamp(0.0, 1.0));
}

#[test]
fn normal_delays_follow_their_distribution() {
    let link = free(30.0, Jitter::Normal { deviation_ms: 4.0 });
    let cdf = distribution(|x| (-0.5 * ((x - 30.0) / 4.0).powi(2)).exp(), 0.0, 70.0);
    assert_distributed("normal", &link, cdf);
}

#[test]
fn gamma_delays_follow_their_distribution() {
    for (mean_ms, deviation_ms) in [(8.0, 4.0), (5.0, 5.0), (2.0, 2.5)] {
        let jitter = Jitter::Gamma {
            mean_ms,
            deviation_ms,
        };
        let shape = f64::powi(mean_ms / deviation_ms, 2);
        let scale = mean_ms / shape;
        // Substitution x = y²: the density has no pole for the tested shapes.
        let root = distribution(
            move |y| y.powf(2.0 * shape - 1.0) * (-y * y / scale).exp(),
            0.0,
            12.0,
        );
        assert_distributed("gamma", &free(10.0, jitter), |x| {
            root((x - 10.0).max(0.0).sqrt())
        });
    }
}

#[test]
fn pareto_delays_follow_their_distribution() {
    let jitter = Jitter::Pareto {
        scale_ms: 6.0,
        exponent: 2.5,
    };
    assert_distributed("pareto", &free(10.0, jitter), |x| {
        1.0 - (1.0 + (x - 10.0).max(0.0) / 6.0).powf(-2.5)
    });
}

#[test]
fn loss_duplicate_and_corruption_rates_match_the_profile() {
    let link = Link {
        loss: 0.05,
        duplicate: 0.02,
        corrupt: 0.03,
        ..Link::default()
    };
    let mut path = path(link, 1);
    let lost: Vec<bool> = (0..PACKETS as u64)
        .map(|n| path.send(n * 1000, 100).is_empty())
        .collect();
    let counts = path.counts();
    let near = |what: &str, count: u64, of: f64, share: f64| {
        let off = (count as f64 - of * share) / (of * share * (1.0 - share)).sqrt();
        assert!(off.abs() < SIGMAS, "{what}: {count} of {of}, {off} sigma");
    };
    let n = PACKETS as f64;
    let arrived = n - counts.lost as f64;
    near("lost", counts.lost, n, 0.05);
    near("doubled", counts.duplicated, arrived, 0.02);
    let arrivals = arrived + counts.duplicated as f64;
    near("flipped", counts.corrupted, arrivals, 0.03);
    // No memory: loss is equally likely after a loss.
    let in_a_row = lost.windows(2).filter(|p| p[0] && p[1]).count() as u64;
    near("lost after a loss", in_a_row, counts.lost as f64, 0.05);
}

/// Run lengths of a value.
fn runs(values: &[bool], of: bool) -> Vec<usize> {
    let runs = values.chunk_by(|a, b| a == b).filter(|run| run[0] == of);
    runs.map(<[bool]>::len).collect()
}

/// Pearson's statistic for geometrically distributed lengths with a given mean, in six classes of about equal
/// share.
fn chi_square_of_geometric(lengths: &[usize], mean: f64) -> f64 {
    let stays: f64 = 1.0 - 1.0 / mean;
    let longer = |k: usize| stays.powf(k as f64);
    let edges: Vec<usize> = [5.0 / 6.0, 4.0 / 6.0, 3.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0_f64]
        .map(|p| (p.ln() / stays.ln()).round() as usize)
        .into();
    let mut low = 0;
    let classes = edges.iter().copied().chain([usize::MAX]);
    classes
        .map(|high| {
            let end = if high == usize::MAX {
                0.0
            } else {
                longer(high)
            };
            let expected = lengths.len() as f64 * (longer(low) - end);
            let seen = lengths.iter().filter(|l| (low + 1..=high).contains(*l));
            let off = seen.count() as f64 - expected;
            low = high;
            off * off / expected
        })
        .sum()
}

#[test]
fn burst_and_gap_lengths_are_geometric() {
    // Critical value of chi square with five degrees of freedom at a significance of 0.001.
    const CHI_SQUARE: f64 = 20.52;
    let bursts = Bursts {
        good_packets: 200.0,
        bad_packets: 20.0,
        loss: 1.0,
        delay_ms: 0.0,
    };
    let link = Link {
        bursts: Some(bursts),
        ..Link::default()
    };
    let mut path = path(link, 4);
    let bad: Vec<bool> = (0..400_000)
        .map(|n| path.send(n * 1000, 100).is_empty())
        .collect();
    for (of, mean) in [(true, 20.0), (false, 200.0)] {
        let mut lengths = runs(&bad, of);
        // The end truncates the last run.
        lengths.pop();
        assert!(lengths.len() > 1500);
        let statistic = chi_square_of_geometric(&lengths, mean);
        assert!(statistic < CHI_SQUARE, "{of}: {statistic}");
        let other = chi_square_of_geometric(&lengths, mean * 1.2);
        assert!(other > CHI_SQUARE, "20 % more goes unseen: {other}");
    }
    let share = bad.iter().filter(|b| **b).count() as f64 / bad.len() as f64;
    assert!((share - 20.0 / 220.0).abs() < 0.008, "{share}");
}

#[test]
fn bad_state_has_its_own_loss_and_delay() {
    let bursts = Bursts {
        good_packets: 100.0,
        bad_packets: 100.0,
        loss: 0.4,
        delay_ms: 60.0,
    };
    let link = Link {
        bursts: Some(bursts),
        ..free(8.0, Jitter::None)
    };
    let delays = delays_ms(link, 5);
    let slow = delays.iter().filter(|d| **d == 68.0).count() as f64;
    let fast = delays.iter().filter(|d| **d == 8.0).count() as f64;
    assert_eq!(slow + fast, delays.len() as f64);
    let lost = PACKETS as f64 - fast;
    assert!((slow / lost - 0.6).abs() < 0.04, "{}", slow / lost);
}

#[test]
fn bottleneck_limits_the_rate_and_queues_packets() {
    let rate = Rate {
        bits_per_s: 1e6,
        queue_bytes: 12_800,
    };
    let link = Link {
        delay_ms: 10.0,
        rate: Some(rate),
        ..Link::default()
    };
    // 1,228 bytes on the wire every 5 ms are twice the link rate.
    let mut path = path(link, 1);
    let arrived: Vec<(u64, u64)> = (0..4000)
        .map(|n| n * 5000)
        .flat_map(|at| path.send(at, 1200).into_iter().map(move |a| (at, a.at_us)))
        .collect();
    let bits = arrived.len() as f64 * (1200 + HEADER_BYTES) as f64 * 8.0;
    let seconds = (arrived[arrived.len() - 1].1 - 10_000) as f64 * 1e-6;
    assert!((bits / seconds / 1e6 - 1.0).abs() < 0.001);
    assert_eq!(path.counts().queue_full, 4000 - arrived.len() as u64);
    // With an empty queue a packet waits for its own transmission only.
    assert_eq!(arrived[0].1, 10_000 + 9824);
    let longest = arrived
        .iter()
        .map(|(at, arrives)| arrives - at)
        .max()
        .unwrap();
    let full_us = 12_800 * 8;
    assert!(longest <= 10_000 + full_us && longest > 10_000 + full_us - 9824);
    // After the queue has drained, the delay is as before.
    let later = path.send(60_000_000, 1200).into_iter().next().unwrap();
    assert_eq!(later.at_us, 60_000_000 + 10_000 + 9824);
}

#[test]
fn packets_are_lost_in_outages_only() {
    let text = "name = \"x\"\n[both]\noutages = { repeat_s = 2, times = [{ from_s = 0.5, to_s = 0.75 }] }\n";
    let profile = Profile::from_toml(text, File::new("x.toml")).unwrap();
    let mut path = Path::new(&profile, 1, 0, Direction::Down);
    for ms in 0..6000 {
        let is_lost = path.send(ms * 1000, 10).is_empty();
        assert_eq!(is_lost, (500..750).contains(&(ms % 2000)), "{ms} ms");
    }
    assert_eq!(path.counts().in_outage, 750);
}

#[test]
fn delay_steps_occur_on_time_and_repeat() {
    let mut path = Path::new(&Profile::named("far-steps").unwrap(), 1, 0, Direction::Up);
    for n in 0..6000 {
        let at = n * 10_000;
        let asked_ms = [30.0, 80.0, 120.0][(n / 1000 % 3) as usize];
        let arrival = path.send(at, 10).into_iter().next().unwrap();
        let delay_ms = (arrival.at_us - at) as f64 * 1e-3;
        // Packets sent after the delay decreased wait for earlier ones.
        let waits = n >= 3000 && (n - 3000) < 12;
        assert!(
            waits || (delay_ms - asked_ms).abs() <= 2.0,
            "{n}: {delay_ms}"
        );
    }
}

#[test]
fn trace_is_replayed_exactly_and_repeats() {
    let dir = tempfile::tempdir().unwrap();
    let rows = [
        (100.0, 12.5, false),
        (110.0, 0.0, true),
        (125.0, 30.25, false),
    ];
    let rows = rows.map(|(time, delay, lost)| format!("{time},{delay},{}", u8::from(lost)));
    let csv = format!("\u{feff}time_ms,delay_ms,lost\n{}\n", rows.join("\n"));
    std::fs::write(dir.path().join("t.csv"), csv).unwrap();
    let file = dir.path().join("p.toml");
    std::fs::write(
        &file,
        "name = \"recorded\"\n[both]\ntrace = \"t.csv\"\ntrace_offset_s = 0\nreorder = true\n",
    )
    .unwrap();
    let profile = Profile::parse(file.to_str().unwrap()).unwrap();
    let mut path = Path::new(&profile, 1, 0, Direction::Up);
    // The last row is as long as the one before it: a period of 40 ms.
    for ms in 0..400 {
        let asked = match ms % 40 {
            0..10 => Some(12_500),
            10..25 => None,
            _ => Some(30_250),
        };
        let delay = path
            .send(ms * 1000, 10)
            .into_iter()
            .next()
            .map(|a| a.at_us - ms * 1000);
        assert_eq!(delay, asked, "{ms} ms");
    }
}

#[test]
fn each_flow_begins_at_its_own_time_of_a_trace_in_both_directions() {
    let dir = tempfile::tempdir().unwrap();
    let rows: Vec<String> = (0..1000).map(|k| format!("{k},{k},0")).collect();
    let csv = format!("time_ms,delay_ms,lost\n{}\n", rows.join("\n"));
    std::fs::write(dir.path().join("t.csv"), csv).unwrap();
    let text = "name = \"recorded\"\n[both]\ntrace = \"t.csv\"\n";
    let mut profile = Profile::from_toml(text, &dir.path().join("p.toml")).unwrap();
    let first_ms = |profile: &Profile, seed, flow| {
        let ways = [Direction::Up, Direction::Down];
        let [up, down] = ways.map(|way| Path::new(profile, seed, flow, way).send(0, 10)[0].at_us);
        assert_eq!(up, down);
        up / 1000
    };
    let begins: BTreeSet<u64> = (0..10)
        .flat_map(|seed| [0, 1].map(|flow| first_ms(&profile, seed, flow)))
        .collect();
    assert!(
        begins.len() > 15 && begins.last() > Some(&800),
        "{begins:?}"
    );
    profile.begin_traces_at(0.25);
    assert_eq!(first_ms(&profile, 1, 1), 250);
}

#[test]
fn invalid_trace_error_names_the_line() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("p.toml");
    std::fs::write(&file, "name = \"x\"\n[down]\ntrace = \"t.csv\"\n").unwrap();
    let sentence = || Profile::parse(file.to_str().unwrap()).unwrap_err();
    assert!(sentence().contains("can not be read"), "{}", sentence());
    for (csv, parts) in [
        ("t,d\n1,2\n", ["line 1", "time_ms,delay_ms,lost"]),
        ("time_ms,delay_ms,lost\n", ["line 1", "at least one row"]),
        (
            "time_ms,delay_ms,lost\n0,1,0\n0,1,0\n",
            ["line 3", "sort the rows"],
        ),
        (
            "time_ms,delay_ms,lost\n0,nan,0\n",
            ["line 2", "from 0 to 60000"],
        ),
        (
            "time_ms,delay_ms,lost\n0,-1,0\n",
            ["line 2", "from 0 to 60000"],
        ),
        (
            "time_ms,delay_ms,lost\n# all\n0,1,maybe\n",
            ["line 3", "write 0 or 1"],
        ),
        ("time_ms,delay_ms,lost\n0,1\n", ["line 2", "are three"]),
    ] {
        std::fs::write(dir.path().join("t.csv"), csv).unwrap();
        for part in parts.into_iter().chain(["p.toml", "t.csv"]) {
            assert!(sentence().contains(part), "{}", sentence());
        }
    }
}

#[test]
fn loss_and_delay_draws_are_independent() {
    let fates = |link: Link| {
        let mut path = path(link, 9);
        (0..5000)
            .map(|n| path.send(n * 1000, 10).into_iter().next().map(|a| a.at_us))
            .collect::<Vec<_>>()
    };
    let link = |loss, jitter| Link {
        loss,
        ..free(40.0, jitter)
    };
    let gamma = Jitter::Gamma {
        mean_ms: 8.0,
        deviation_ms: 5.0,
    };
    let (none, some) = (fates(link(0.0, gamma)), fates(link(0.2, gamma)));
    assert!(none.iter().zip(&some).all(|(a, b)| b.is_none() || a == b));
    let other = fates(link(0.2, Jitter::Uniform { reach_ms: 3.0 }));
    assert!(
        some.iter()
            .zip(&other)
            .all(|(a, b)| a.is_some() == b.is_some())
    );
}

/// An arrived packet.
#[derive(Debug, PartialEq)]
struct Delivery {
    sent_us: u64,
    at_us: u64,
    flow: u64,
    direction: Direction,
    corrupted: Option<Corruption>,
    n: u64,
}

/// Sends packets of three flows in both directions and collects them in order of arrival.
fn through(profile: &Profile, seed: u64) -> Vec<Delivery> {
    let directions = [Direction::Up, Direction::Down];
    let of_flow = |flow| directions.map(|d| Path::new(profile, seed, flow, d));
    let mut paths = [0, 1, 2].map(of_flow);
    let mut queue = EventQueue::default();
    for n in 0..2000 {
        let (flow, way, sent_us) = (n % 3, (n % 2) as usize, n * 700);
        for Arrival { at_us, corrupted } in paths[flow as usize][way].send(sent_us, 200) {
            let delivery = Delivery {
                sent_us,
                at_us,
                flow,
                direction: directions[way],
                corrupted,
                n,
            };
            queue.push(at_us, delivery);
        }
    }
    std::iter::from_fn(|| queue.pop_due(u64::MAX).map(|(_, d)| d)).collect()
}

#[test]
fn equal_seeds_give_equal_deliveries_and_other_seeds_differ() {
    for name in Profile::names() {
        let profile = Profile::named(name).unwrap();
        assert_eq!(through(&profile, 7), through(&profile, 7));
        if name != "none" {
            assert_ne!(through(&profile, 7), through(&profile, 8), "{name}");
        }
    }
}

#[test]
fn flows_and_directions_are_independent() {
    let lossy = Profile::named("lossy").unwrap();
    let fates = |flow, direction| {
        let mut path = Path::new(&lossy, 7, flow, direction);
        (0..500).map(|n| path.send(n, 1)).collect::<Vec<_>>()
    };
    assert_ne!(fates(0, Direction::Up), fates(0, Direction::Down));
    assert_ne!(fates(0, Direction::Up), fates(1, Direction::Up));
}

proptest! {
    #[test]
    fn delays_are_not_negative_and_order_is_kept_without_reordering(
        seed: u64,
        reorder: bool,
        name in prop::sample::select(Profile::names().collect::<Vec<_>>()),
    ) {
        let mut profile = Profile::named(name).unwrap();
        profile.up.reorder = reorder;
        profile.down.reorder = reorder;
        let arrived = through(&profile, seed);
        prop_assert!(arrived.is_sorted_by_key(|d| d.at_us));
        for d in &arrived {
            prop_assert!(d.at_us >= d.sent_us);
        }
        if !reorder {
            for flow in 0..3 {
                for direction in [Direction::Up, Direction::Down] {
                    let own = arrived.iter().filter(|d| d.flow == flow && d.direction == direction);
                    prop_assert!(own.is_sorted_by_key(|d| d.n));
                }
            }
        }
    }

    #[test]
    fn corruption_flips_one_to_four_bits_within_the_packet(seed: u64, len in 0_usize..64) {
        let mut path = path(Link { corrupt: 1.0, ..Link::default() }, seed);
        let arrival = path.send(0, len).into_iter().next().unwrap();
        let mut bytes = vec![0; len];
        arrival.corrupted.unwrap().apply(&mut bytes);
        let flipped: u32 = bytes.iter().map(|b| b.count_ones()).sum();
        prop_assert!(len == 0 || (1..=4).contains(&flipped));
    }
}

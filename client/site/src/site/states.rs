//! Checks a site's transitions against the state table of the protocol document.

use super::resync_policy::DRIFT_MAX_M;
use super::tests::*;
use super::*;
use crate::test_support::check_transitions;

const STATES: [&str; 4] = ["Same", "Asked", "Applying", "Ended"];

fn state_of(site: &Site, result: &Result<(), SiteError>) -> &'static str {
    match (result, site.resync_state) {
        (Err(SiteError::Again(_)), _) => "Ended",
        (Err(error), _) => panic!("{error}"),
        (Ok(()), ResyncState::Idle) => "Same",
        (Ok(()), ResyncState::Asked) => "Asked",
        (Ok(()), ResyncState::Applying) => "Applying",
    }
}

/// A welcome to a log of one cut, from the operation `first` on.
fn return_at(first: u64) -> ClientEvent {
    ClientEvent::Welcomed(Box::new(Welcome {
        first_operation: OperationId(first),
        operations_so_far: 1,
        topology_version: 1,
        topology_hash: hash_of_the_cut(),
        ..welcome(0)
    }))
}

/// A cut whose topology differs from the log's. It is applied at its due time, or at once during the initial log.
fn other_cut(site: &mut Site) -> Result<(), SiteError> {
    site.handle_event(cut_of(TopologyHash(1)), ms(2010))?;
    site.advance(ms(2020))
}

fn drift_for(site: &mut Site, until_ms: i64) {
    for t in (3000..=3000 + until_ms).step_by(100) {
        let s = site.view_step(ms(t), budget()).map(|frame| frame.s);
        let drift = Drift {
            max_m: 2.0 * DRIFT_MAX_M,
            nodes: 1,
        };
        site.handle_drift(s.unwrap_or(ServerTime::ZERO), drift, ms(t));
    }
}

fn run(from: &str, what: &str) -> &'static str {
    let mut site = site(0);
    assert!(site.view_step(ms(10), budget()).is_some());
    if from != "Same" {
        other_cut(&mut site).unwrap();
    }
    if from == "Applying" {
        tell(&mut site, return_at(0), 2030);
    }
    assert_eq!(state_of(&site, &Ok(())), from);
    let result = match what {
        "a cut that makes what the server says" => {
            tell(&mut site, cut_of(hash_of_the_cut()), 2010);
            site.advance(ms(2020))
        }
        "a cut that makes another topology" => other_cut(&mut site),
        "the server finds another topology" => {
            let refused = RequestRefused {
                id: RequestId(1),
                reason: RequestRefusal::TopologyDiffers,
            };
            site.handle_event(ClientEvent::RequestRefused(refused), ms(2010))
        }
        "off by more than 0.5 mm for 0.9 s" => {
            drift_for(&mut site, 900);
            Ok(())
        }
        "off by more than 0.5 mm for 1 s" => {
            drift_for(&mut site, 1000);
            Ok(())
        }
        "a return at which the log goes on" => {
            if from == "Same" {
                tell(&mut site, cut_of(hash_of_the_cut()), 2010);
            }
            site.handle_event(return_at(1), ms(2040))
        }
        "a return at which the log does not go on" => site.handle_event(return_at(1), ms(2040)),
        "a return at which the whole log comes" => {
            if from == "Same" {
                tell(&mut site, cut_of(hash_of_the_cut()), 2010);
            }
            site.handle_event(return_at(0), ms(2040))
        }
        "the log is applied" => {
            tell(&mut site, cut_of(hash_of_the_cut()), 2050);
            site.handle_event(ClientEvent::CaughtUp, ms(2060))
        }
        other => panic!("no test for \"{other}\" of a replica"),
    };
    state_of(&site, &result)
}

#[test]
fn replica_transitions_match_documented_table() {
    check_transitions("Replica", &STATES, run);
}

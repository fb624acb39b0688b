//! Pages that break the format or use up what a page may, beside an honest page.

use std::sync::Arc;
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio::task::JoinSet;
use tokio::time::{interval, sleep, timeout};
use tokio_tungstenite::tungstenite::Message;

use super::pages::{self, stay};
use super::{AGAIN, Target};
use crate::headless_page::{HeadlessPage, PageAddress, PageError, Received};

/// Messages of the flood per millisecond: 10,000 per second.
const FLOOD_PER_MS: usize = 10;

/// Bytes of huge messages and of huge annotations.
const HUGE_BYTES: usize = 10 << 20;
const ANNOTATION_BYTES: usize = 1 << 20;

/// Markup within the size of an annotation.
const MARKUP: &str = "<img src=x onerror=alert(1)><script>alert(2)</script>";

/// The text of a spectator's annotation, which no page may show.
const FORBIDDEN_TEXT: &str = "an annotation of a spectator";

/// A page from another site.
const FOREIGN_ORIGIN: &str = "http://foreign.example";

/// Pages that never read.
const DEAF_PAGES: usize = 4;

/// Time between the messages of a page that never reads, so that it is not silent.
const DEAF_PING_EVERY: Duration = Duration::from_millis(500);

/// Time between two joins of the page that reconnects. With all others it stays below the ten joins per second that a
/// server grants to spectators, because newcomers share them.
const RECONNECT_EVERY: Duration = Duration::from_millis(250);

/// Pause of the other pages between two attempts.
const PAUSE: Duration = Duration::from_secs(2);

/// Maximum time until the server ends a page that broke the format.
const END_WITHIN: Duration = Duration::from_secs(5);

const ACCEPTED_ORIGIN: &str = "foreign origins accepted";
const SHOWN: &str = "annotations of a spectator shown";
const ENDURED: &str = "pages that broke the format and were not ended";

/// Events that must not happen: those of honest pages, and the ones of this attack.
pub(super) const FORBIDDEN: &[&str] = &[
    pages::BROKEN,
    pages::LATE,
    pages::ENDED,
    ACCEPTED_ORIGIN,
    SHOWN,
    ENDURED,
];

/// An honest page, and all the others at once.
pub(super) async fn bad_pages(target: Arc<Target>) {
    let page = |role: &str| target.page(role);
    let (Some(spectator), Some(trainee), Some(instructor)) =
        (page("spectator"), page("trainee"), page("instructor"))
    else {
        return;
    };
    let mut all = JoinSet::new();
    let (t, a) = (Arc::clone(&target), spectator.clone());
    all.spawn(async move { stay(&t, &a, "honest-page").await });
    let (t, a) = (Arc::clone(&target), spectator.clone());
    all.spawn(async move { watch_annotations(&t, &a).await });
    for i in 0..DEAF_PAGES {
        let (t, a) = (Arc::clone(&target), spectator.clone());
        all.spawn(async move { never_read(&t, &a, i).await });
    }
    let (t, a) = (Arc::clone(&target), spectator.clone());
    all.spawn(async move { flood(&t, &a).await });
    let (t, a) = (Arc::clone(&target), spectator.clone());
    all.spawn(async move { reconnect(&t, &a).await });
    let (t, a) = (Arc::clone(&target), spectator.clone());
    all.spawn(async move { foreign_origin(&t, &a).await });
    for (name, address, message) in [
        (
            "huge-page",
            &spectator,
            Message::text("x".repeat(HUGE_BYTES)),
        ),
        (
            "long-page",
            &instructor,
            annotation(&"x".repeat(ANNOTATION_BYTES)),
        ),
        ("nan-page", &trainee, nan_pose()),
    ] {
        let (t, a) = (Arc::clone(&target), address.clone());
        all.spawn(async move { break_format(&t, &a, name, message).await });
    }
    let (t, a) = (Arc::clone(&target), spectator);
    all.spawn(async move { annotate(&t, &a, "spectator-page", FORBIDDEN_TEXT).await });
    let (t, a) = (Arc::clone(&target), instructor);
    all.spawn(async move { annotate(&t, &a, "markup-page", MARKUP).await });
    while all.join_next().await.is_some() {}
}

/// Joins under a new name each time, with a tool if the role has one.
async fn join(target: &Target, address: &PageAddress, name: &str) -> Option<HeadlessPage> {
    let tool = json!({"kind": "ball", "radius_mm": 5, "length_mm": 0, "width_mm": 0});
    let number = target.number();
    match HeadlessPage::join(address, &format!("{name}-{number}"), Some(&tool)).await {
        Ok(page) => {
            target.count("joined");
            Some(page)
        }
        Err(error) => {
            target.count(match error {
                PageError::Refused(_) => "refused to join",
                _ => "failed to join",
            });
            sleep(AGAIN).await;
            None
        }
    }
}

/// Sends ten thousand messages per second.
async fn flood(target: &Target, address: &PageAddress) {
    loop {
        if let Some(page) = join(target, address, "flood-page").await {
            let mut socket = page.into_socket();
            let ping = json!({"type": "ping", "id": 1, "sent_ms": 0.0}).to_string();
            let sending = async {
                let mut ticks = interval(Duration::from_millis(1));
                loop {
                    ticks.tick().await;
                    for _ in 0..FLOOD_PER_MS {
                        if socket.feed(Message::text(ping.clone())).await.is_err() {
                            return;
                        }
                    }
                    if socket.flush().await.is_err() {
                        return;
                    }
                    target.add("messages of the flood", FLOOD_PER_MS as u64);
                }
            };
            ended(target, timeout(END_WITHIN, sending).await.is_ok());
        }
        sleep(PAUSE).await;
    }
}

/// Sends a message for which the server has to end the page.
async fn break_format(target: &Target, address: &PageAddress, name: &str, message: Message) {
    loop {
        if let Some(page) = join(target, address, name).await {
            let mut socket = page.into_socket();
            let ending = async {
                // The connection may end while a large message is being sent.
                if socket.send(message.clone()).await.is_ok() {
                    while let Some(Ok(received)) = socket.next().await {
                        if received.is_close() {
                            return;
                        }
                    }
                }
            };
            ended(target, timeout(END_WITHIN, ending).await.is_ok());
        }
        sleep(PAUSE).await;
    }
}

fn ended(target: &Target, is_ended: bool) {
    target.count(if is_ended {
        "pages ended by the server"
    } else {
        ENDURED
    });
}

/// Sends annotations, which the server shows or refuses, and reads the answers.
async fn annotate(target: &Target, address: &PageAddress, name: &str, text: &str) {
    let message = annotation_json(text);
    loop {
        if let Some(page) = join(target, address, name).await {
            let exchange = send_and_read(target, page, &message);
            let _ = timeout(PAUSE, exchange).await;
        }
        sleep(PAUSE).await;
    }
}

/// Sends a message and reads until the connection ends.
async fn send_and_read(
    target: &Target,
    mut page: HeadlessPage,
    message: &Value,
) -> Result<(), PageError> {
    page.send(message).await?;
    target.count("annotations sent");
    loop {
        if let Received::Text(text) = page.next().await?
            && text["type"] == "notice"
        {
            target.count("notices to pages");
        }
    }
}

/// Counts states with the annotation of a spectator. Markup has to arrive as text.
async fn watch_annotations(target: &Target, address: &PageAddress) {
    loop {
        let Some(mut page) = join(target, address, "reader-page").await else {
            continue;
        };
        while let Ok(received) = page.next().await {
            let Received::Text(state) = received else {
                continue;
            };
            for annotation in state["annotations"].as_array().into_iter().flatten() {
                match annotation["text"].as_str() {
                    Some(FORBIDDEN_TEXT) => target.count(SHOWN),
                    Some(MARKUP) => target.count("states with markup as text"),
                    _ => {}
                }
            }
        }
        target.count(pages::ENDED);
    }
}

/// Sends pings and reads nothing, until the connection ends.
async fn never_read(target: &Target, address: &PageAddress, number: usize) {
    loop {
        if let Some(page) = join(target, address, &format!("deaf-page-{number}")).await {
            let mut socket = page.into_socket();
            let ping = Message::text(json!({"type": "ping", "id": 1, "sent_ms": 0.0}).to_string());
            while socket.send(ping.clone()).await.is_ok() {
                sleep(DEAF_PING_EVERY).await;
            }
            target.count("pages that never read ended");
        }
        sleep(PAUSE).await;
    }
}

/// Joins and drops the connection.
async fn reconnect(target: &Target, address: &PageAddress) {
    loop {
        drop(join(target, address, "quick-page").await);
        sleep(RECONNECT_EVERY).await;
    }
}

/// Opens the connection from the page of another site.
async fn foreign_origin(target: &Target, address: &PageAddress) {
    loop {
        let opened = HeadlessPage::open(address, Some(FOREIGN_ORIGIN)).await;
        target.count(match opened {
            Ok(_) => ACCEPTED_ORIGIN,
            Err(_) => "foreign origins refused",
        });
        sleep(RECONNECT_EVERY).await;
    }
}

fn annotation_json(text: &str) -> Value {
    json!({
        "type": "control", "act": "annotate", "text": text, "kind": "pin", "nodes": [0, 1, 2],
        "weights": [1.0, 0.0, 0.0], "offset_m": [0.0, 0.0, 0.0],
    })
}

fn annotation(text: &str) -> Message {
    Message::text(annotation_json(text).to_string())
}

/// A motion message of one sample at a place that is not a number.
fn nan_pose() -> Message {
    let mut bytes = vec![16, 1, 0, 0];
    bytes.extend(1e6_f64.to_le_bytes());
    for x in [f32::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] {
        bytes.extend(x.to_le_bytes());
    }
    bytes.extend(0_u32.to_le_bytes());
    Message::binary(bytes)
}

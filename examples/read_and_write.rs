//! A consumer and writer in Rust: read_and_write tcp/127.0.0.1:7447 plant mixer recipe 7
//!
//! Cargo.toml: zenoh = "1.10", serde_json = "1", tokio = { version = "1", features = ["full"] }.
//! It prints every good value of the tag; after five seconds it writes a value, if there is one,
//! and ends: with 1 unless the device acknowledged the write.
use serde_json::Value;
use std::{process::ExitCode, time::Duration};
use zenoh::sample::SampleKind;

fn shown(text: &str) -> String {
    let known: Value = serde_json::from_str(text).unwrap_or_default();
    match (known["quality"].as_str(), known["origin"].as_str()) {
        (Some("good"), Some("simulated" | "replayed")) => format!("not real: {}", known["value"]),
        (Some("good"), _) => known["value"].to_string(),
        _ => format!("not good: {}", known["reason"]), // it has no value to use
    }
}

#[tokio::main]
async fn main() -> zenoh::Result<ExitCode> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [endpoint, prefix, device, tag, value @ ..] = words.as_slice() else {
        return Ok(ExitCode::from(2));
    };
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", r#""client""#)?;
    config.insert_json5("connect/endpoints", &format!(r#"["{endpoint}"]"#))?;
    let session = zenoh::open(config).await?;
    let key = format!("{prefix}/{device}/{tag}");
    let token = format!("{prefix}/@gateway/*/alive/{device}");
    let tokens = session
        .liveliness()
        .declare_subscriber(token)
        .history(true)
        .await?;
    let values = session.declare_subscriber(&key).await?;
    let end = tokio::time::sleep(Duration::from_secs(if value.is_empty() {
        u64::MAX / 4
    } else {
        5
    }));
    tokio::pin!(end);
    loop {
        tokio::select! {
            _ = &mut end => break,
            Ok(token) = tokens.recv_async() => match token.kind() {
                SampleKind::Put => println!("the device is there"),
                SampleKind::Delete => println!("the device is gone: its last value is not good"),
            },
            Ok(sample) = values.recv_async() =>
                println!("{}", shown(&sample.payload().try_to_string().unwrap_or_default())),
        }
    }
    let within = Duration::from_secs(10);
    let replies = session
        .get(format!("{key}/@set"))
        .payload(&value[0])
        .timeout(within)
        .await?;
    while let Ok(reply) = replies.recv_async().await {
        match reply.result() {
            Ok(done) => {
                println!(
                    "written: {}",
                    done.payload().try_to_string().unwrap_or_default()
                );
                return Ok(ExitCode::SUCCESS);
            }
            Err(failed) => println!(
                "not acknowledged: {}",
                failed.payload().try_to_string().unwrap_or_default()
            ),
        }
    }
    // No answer, or `unclear`: it may be done. Read the value, do not repeat.
    println!("the device did not acknowledge");
    Ok(ExitCode::FAILURE)
}

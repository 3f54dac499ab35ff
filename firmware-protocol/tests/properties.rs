//! Tests properties that hold for arbitrary bytes and messages.

use firmware_protocol::{
    Decoder, DeviceState, DisarmReply, HelloReply, RefusalReason, Reply, Request, SampleReply,
    StatusBits,
};
use proptest::prelude::*;
use proptest::sample::select;

fn request() -> impl Strategy<Value = Request> {
    prop_oneof![
        any::<u16>().prop_map(|protocol_version| Request::Hello { protocol_version }),
        any::<u32>().prop_map(|nonce| Request::Arm { nonce }),
        Just(Request::Sample),
        any::<(i16, u32)>()
            .prop_map(|(voltage_mv, sampled_at_us)| Request::Act { voltage_mv, sampled_at_us }),
        Just(Request::Disarm),
    ]
}

fn reply() -> impl Strategy<Value = Reply> {
    let hello = (any::<(u16, [u8; 3], u8, u16)>(), any::<([u8; 8], u32, u16, u16)>()).prop_map(
        |(
            (protocol_version, firmware_version, kind, module_id),
            (serial, nonce, boot_id, dropped_frames),
        )| {
            Reply::Hello(HelloReply {
                protocol_version,
                firmware_version,
                kind,
                module_id,
                serial,
                nonce,
                boot_id,
                dropped_frames,
            })
        },
    );
    let sample = (any::<(u32, i32, i32, i32)>(), any::<(i16, u8, i16, u16, u16)>()).prop_map(
        |(
            (device_time_us, theta_counts, alpha_counts, tachometer_counts_s),
            (current_ma, status, applied_mv, last_act_sequence, sample_to_act_us),
        )| {
            Reply::Sample(SampleReply {
                device_time_us,
                theta_counts,
                alpha_counts,
                tachometer_counts_s,
                current_ma,
                status: StatusBits(status),
                applied_mv,
                last_act_sequence,
                sample_to_act_us,
            })
        },
    );
    let disarm = (select(DeviceState::ALL), any::<u32>(), any::<u16>()).prop_map(
        |(state, nonce, dropped_frames)| {
            Reply::Disarm(DisarmReply { state, nonce, dropped_frames })
        },
    );
    let refusal = (any::<u8>(), select(RefusalReason::ALL))
        .prop_map(|(refused_type, reason)| Reply::Refusal { refused_type, reason });
    prop_oneof![
        hello,
        any::<u32>().prop_map(|device_time_us| Reply::Arm { device_time_us }),
        sample,
        disarm,
        refusal,
    ]
}

proptest! {
    #[test]
    fn any_request_comes_back_after_any_noise(
        noise in prop::collection::vec(any::<u8>(), 0..100),
        sequence: u16,
        request in request(),
    ) {
        let mut decoder = Decoder::new();
        for byte in noise.into_iter().chain([0]) {
            decoder.push(byte);
        }
        let encoded = request.encode(sequence);
        let (last, before) = encoded.as_bytes().split_last().unwrap();
        prop_assert_eq!(*last, 0);
        for &byte in before {
            prop_assert_ne!(byte, 0);
            prop_assert_eq!(decoder.push(byte), None);
        }
        let frame = decoder.push(0).unwrap().unwrap();
        prop_assert_eq!(frame.sequence, sequence);
        prop_assert_eq!(Request::parse(&frame), Ok(request));
        prop_assert!(Reply::parse(&frame).is_err());
    }

    #[test]
    fn any_reply_comes_back(sequence: u16, reply in reply()) {
        let encoded = reply.encode(sequence);
        let mut decoder = Decoder::new();
        let frame =
            encoded.as_bytes().iter().find_map(|&byte| decoder.push(byte)).unwrap().unwrap();
        prop_assert_eq!(frame.sequence, sequence);
        prop_assert_eq!(Reply::parse(&frame), Ok(reply));
        prop_assert!(Request::parse(&frame).is_err());
    }

    #[test]
    fn any_bytes_are_safe(stream in prop::collection::vec(any::<u8>(), 0..2000)) {
        let mut decoder = Decoder::new();
        for byte in stream {
            if let Some(Ok(frame)) = decoder.push(byte) {
                let _ = (Request::parse(&frame), Reply::parse(&frame));
            }
        }
    }

    /// Tests content with a right checksum, because random bytes hardly ever pass the check.
    #[test]
    fn any_content_with_a_right_checksum_is_safe(
        content in prop::collection::vec(any::<u8>(), 0..60),
    ) {
        let checksum = crc::Crc::<u16>::new(&crc::CRC_16_IBM_SDLC).checksum(&content);
        let mut body = content;
        body.extend(checksum.to_le_bytes());
        let mut encoded = vec![0; body.len() + 2];
        let length = cobs::encode(&body, &mut encoded);
        encoded.truncate(length);
        let mut decoder = Decoder::new();
        for byte in encoded {
            prop_assert_eq!(decoder.push(byte), None);
        }
        if let Some(Ok(frame)) = decoder.push(0) {
            prop_assert_eq!(frame.payload().len() + 5, body.len());
            let _ = (Request::parse(&frame), Reply::parse(&frame));
        }
    }
}

// May the hand lift? The newest verdict of a graspd daemon, and `unknown` where there is none.
//
// One header to copy: C++17, Linux, cppzmq and nlohmann-json (apt install cppzmq-dev
// nlohmann-json3-dev, link with -lzmq). The messages are those of deploy/wire/README.md, version 1;
// the rules are those of ../python/graspd_client.py, step by step.
//
//     graspd::Client client(options);  // with an endpoint and an ask_endpoint
//     if (const auto answer = client.may_i_lift(0.5))
//         client.tell(answer.verdict, lift() ? graspd::Outcome::held : graspd::Outcome::slipped);
//
// Nothing here runs by itself but ZeroMQ's own thread, and an object belongs to the thread that
// made it. Only `verdict(wait_s)`, `may_i_lift(deadline_s)`, `wait_for_grasp(deadline_s)`,
// `wait_for_slide(timeout_s)` and `tell(..., wait_s)` wait, and no longer than told.
#pragma once

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <deque>
#include <fstream>
#include <functional>
#include <iostream>
#include <iterator>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <set>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <unistd.h>

#include <nlohmann/json.hpp>
#include <zmq_addon.hpp>

namespace graspd {

using Nanoseconds = std::int64_t;

constexpr std::int64_t VERSION = 1;  // of the messages; what has another is not understood
constexpr std::uint64_t INTEGER_MAX = std::uint64_t{1} << 60;  // as a time, 36 years in ns
constexpr double REAL_MAX = 1e12;                              // as a time, thirty years in ms
constexpr double WAIT_MAX_S = 1e9;                             // of a call: thirty years
// A verdict has 0.7 kB, at most 3; a peer that sends more is not a daemon and is disconnected.
constexpr std::size_t MESSAGE_MAX_BYTES = 1 << 16;
// Of lists and objects in a message, and so its depth; a verdict has ten.
constexpr std::ptrdiff_t OPENINGS_MAX = 100;
constexpr int QUEUE_MAX = 1000;  // messages that wait to be read: ten seconds at 100 Hz
// A client that has not read for longer reconnects: what waits is old, and newer ones are lost.
constexpr Nanoseconds READ_WITHIN_NS = 5'000'000'000;
// A client without a message for this long reconnects, at first and at most: libzmq does not try
// a refused peer again, which may be let in by now.
constexpr Nanoseconds QUIET_NS = 1'000'000'000, QUIET_MAX_NS = 10'000'000'000;
// The computer has slept if its clocks have moved apart by more. A sleep takes seconds, the
// scheduler a moment between two looks at the clocks.
constexpr Nanoseconds SLEPT_NS = 50'000'000;
// Longest wait in one piece: so well is it known when a message came from another computer.
constexpr std::int64_t SLICE_MS = 10;
// What a message may come from the future by before the clocks count as different ones.
constexpr Nanoseconds CLOCK_SLACK_NS = 1'000'000;
// By which two computers' clocks may run apart: NTP slews by 5e-4, a bad crystal is off by 1e-4.
constexpr double DRIFT = 1e-3;
// By which they may have run apart in all: a delay that grows as slowly looks the same.
constexpr Nanoseconds DRIFT_MAX_NS = 20'000'000;
// Between two questions for the daemon's clock, and after one that was not answered.
constexpr Nanoseconds CLOCK_EVERY_NS = 1'000'000'000, CLOCK_RETRY_NS = 10'000'000'000;
constexpr std::size_t FORMER_MAX = 16;  // starts of the daemon that are remembered as over
// On TCP: between two signs of life, and when a daemon that gives none is connected to again.
constexpr int HEARTBEAT_MS = 1000, HEARTBEAT_TIMEOUT_MS = 3000;
constexpr std::size_t OBJECT_MAX = 64;  // characters of an object's name
constexpr std::size_t NAME_BYTES = 16;   // of a client's name
constexpr std::size_t LIFTS_MAX = 256;  // that are remembered: as many as graspd takes outcomes of
constexpr std::int64_t WARN_EVERY = 10;  // lifts whose outcome was never told
// Longest wait at the end until graspd has received that no lift follows, and most connections
// that say so at a time.
constexpr int TAKE_BACK_MS = 200;
constexpr std::size_t LEAVING_MAX = 4;

// What graspd decided about a grasp; the numbers are those of `verdict_code`.
enum class Decision { unknown = 0, stable = 1, slip = 2 };

// The wire's word for it.
inline const char* name(Decision decision) {
    constexpr const char* names[] = {"unknown", "stable", "slip"};
    return names[static_cast<int>(decision)];
}

// What a finger feels.
enum class FingerState { free, touch, slide };

// The wire's word for it.
inline const char* name(FingerState state) {
    constexpr const char* names[] = {"free", "touch", "slide"};
    return names[static_cast<int>(state)];
}

// How a lift ended.
enum class Outcome { held, slipped, not_lifted };

// Outcomes of `stable` lifts: `lifts` were told, `slips` of them slipped.
struct Risk {
    std::optional<double> target;  // share of slips that is allowed; none: no risk is set
    std::int64_t lifts = 0, slips = 0;
    std::int64_t outstanding = 0;  // outcomes that can still come
    std::optional<double> bound;   // of `slips`; each outstanding lift adds one
    std::int64_t warm_up_left = 0;  // outcomes until most grasps need no supervision
    std::int64_t announced = 0;     // `lift` questions that were answered `stable`
    std::int64_t awaited = 0;  // those without an outcome; too many, and nothing is `stable`
};

// What is known of the grasp. True in an `if` exactly when it is stable; then no person need watch.
struct Verdict {
    Decision decision = Decision::unknown;
    // Why it is unknown: the daemon's reasons, or one of those in deploy/clients/README.md.
    std::vector<std::string> reasons;
    std::optional<double> p_slip;        // probability of slip; none when unknown
    std::optional<std::int64_t> grasp;   // number of the contact episode
    std::optional<std::int64_t> seq;
    std::string boot_id;                 // empty before the first message
    std::optional<double> age_ms;        // since the reading's last byte, at least
    std::optional<double> p_slip_model;  // what the network alone says
    std::int64_t outcomes = 0;           // of lifts, that `p_slip` rests on
    bool supervised = false;             // its lift would teach, but only while a person watches
    std::optional<Risk> risk;
    // Judged when nothing moved fast, but something might still slide slowly.
    bool early = false;
    // For how long the hand has been still: from 100 on nothing moves fast, from 240 on nothing
    // slides slowly either; none if the daemon does not say.
    std::optional<double> still_ms;
    // How each finger moves, in units of its own noise, none where that is not known; and what it
    // is at most while it is still.
    std::map<std::string, std::optional<double>> motion;
    std::map<std::string, double> motion_limits;
    // What each finger feels, none where that is not known, and always where the reading is older
    // than `max_age_ms`.
    std::map<std::string, std::optional<FingerState>> fingers;
    // `you` if you report the outcome of the lift, `another` if another controller does, which may
    // be lifting; empty if the daemon does not say.
    std::string owner;

    explicit operator bool() const { return decision == Decision::stable && !supervised; }

    // The same, but unknown, and not to be lifted.
    Verdict unknown(std::vector<std::string> why) const {
        Verdict same = *this;
        same.decision = Decision::unknown;
        same.reasons = std::move(why);
        same.p_slip = same.p_slip_model = std::nullopt;
        same.supervised = false;
        return same;
    }
};

// Whether to lift. True in an `if` exactly when the hand may.
struct LiftAnswer {
    Verdict verdict;  // what it was decided by; besides its usual reasons `no-answer` and `late`
    double waited_s = 0.0;
    // It may, but only while a person watches; never true unless such lifts were asked for.
    bool supervised = false;

    explicit operator bool() const { return static_cast<bool>(verdict) || supervised; }
};

// Words of the fingers during a lift. True in an `if` exactly when it is to be stopped.
struct SlideAnswer {
    Verdict verdict;  // the newest; its `fingers` and `reasons` say what is known
    double waited_s = 0.0;
    std::vector<std::string> sliding = {};  // fingers along which something slides
    // All fingers that touched still did when the time was over, and nothing slid.
    bool held = false;

    explicit operator bool() const { return !held; }
};

// Whether graspd has taken how a lift ended. True in an `if` exactly when it has.
struct OutcomeAnswer {
    // Why not: the daemon's words, or `no-answer`, `malformed`, `version` or `other-process`.
    std::string why;

    explicit operator bool() const { return why.empty(); }
};

// What came since the start.
struct Counts {
    std::int64_t messages = 0;   // new ones of this hand
    std::uint64_t lost = 0;      // gaps in `seq`, in messages
    std::int64_t repeats = 0;    // messages that were known already
    std::int64_t malformed = 0;  // messages that are not understood, answers too
    std::int64_t restarts = 0;   // times that the daemon was started again
    std::int64_t former = 0;     // messages of a start that is over
};

// CURVE keys, Z85: the daemon's public one, and one's own two.
struct Keys {
    std::string server_key, public_key, secret_key;

    // From the daemon's `.key` and one's own `.key_secret` file (`graspd keys`).
    // Throws `std::runtime_error`.
    static Keys load(const std::string& server, const std::string& own) {
        return {value(server, "public-key"), value(own, "public-key"), value(own, "secret-key")};
    }

private:
    static std::string value(const std::string& path, const std::string& which) {
        std::ifstream file(path);
        for (std::string line; std::getline(file, line);) {
            const auto at = line.find(which + " = \"");
            const auto from = line.find('"') + 1;
            const auto to = line.rfind('"');
            if (at != std::string::npos && to > from) return line.substr(from, to - from);
        }
        throw std::runtime_error(path + ": no " + which);
    }
};

struct Options {
    std::string endpoint;
    std::string hand = "right";
    double max_age_ms = 100.0;  // how old a reading may be that a lift relies on
    // `[ask]`; with it `may_i_lift` asks for a judgement as well, and `tell` has whom to tell.
    std::string ask_endpoint = {};
    // Whether the daemon's monotonic clock is one's own. Unless given, it is with ipc:// and on
    // loopback addresses: say false through a tunnel.
    std::optional<bool> same_computer = {};
    std::optional<Keys> keys = {};
    // A `stable` with this `p_slip` or more does not count: the scene's `slip_threshold`, if that
    // is higher.
    double max_p_slip = 0.5;
    // Is told of lifts that were allowed and whose outcome was not: of the first and each tenth.
    std::function<void(const std::string&)> warn = [](const std::string& text) {
        std::cerr << "graspd_client: " << text << '\n';
    };
};

namespace detail {

using nlohmann::json;

inline Nanoseconds now_ns(clockid_t clock = CLOCK_MONOTONIC) {
    timespec now{};
    clock_gettime(clock, &now);
    return static_cast<Nanoseconds>(now.tv_sec) * 1'000'000'000 + now.tv_nsec;
}

// How long the computer has slept, and something constant: only the first clock counts that.
inline Nanoseconds slept_ns() {
    const Nanoseconds awake_and_asleep_ns = now_ns(CLOCK_BOOTTIME);
    return awake_and_asleep_ns - now_ns();
}

inline bool is_same_computer(std::string_view endpoint) {
    for (const std::string_view local : {"ipc://", "tcp://127.", "tcp://[::1]", "tcp://localhost:"})
        if (endpoint.substr(0, local.size()) == local) return true;
    return false;
}

using Key = std::pair<std::string, std::int64_t>;  // names a grasp

inline Key key(const Verdict& said) { return {said.boot_id, said.grasp.value_or(0)}; }

// What matters of a verdict message.
struct Message {
    Verdict verdict;               // without its age
    Nanoseconds read_ns = 0;       // by the daemon's clock: when the reading's last byte came ...
    Nanoseconds published_ns = 0;  // ... and when the message went out
    Nanoseconds silence_ns = 0;
};

struct Malformed {};

inline const json& field(const json& told, const std::string& name) {
    const auto found = told.find(name);
    if (found == told.end()) throw Malformed{};
    return *found;
}

inline std::int64_t integer(const json& told, const std::string& name) {
    const json& value = field(told, name);
    if (!value.is_number_integer()) throw Malformed{};
    if (value.is_number_unsigned() && value.get<std::uint64_t>() > INTEGER_MAX) throw Malformed{};
    const auto number = value.get<std::int64_t>();
    if (number < 0) throw Malformed{};
    return number;
}

inline double number(const json& told, const std::string& name, double most) {
    const json& value = field(told, name);
    if (!value.is_number()) throw Malformed{};
    const auto number = value.get<double>();
    if (!(number >= 0.0 && number <= most)) throw Malformed{};
    return number;
}

inline Nanoseconds milliseconds(const json& told, const std::string& name) {
    return std::llrint(number(told, name, REAL_MAX) * 1e6);
}

inline std::optional<double> maybe(const json& told, const std::string& name, double most) {
    if (field(told, name).is_null()) return std::nullopt;
    return number(told, name, most);
}

inline std::string text(const json& value) {
    if (!value.is_string()) throw Malformed{};
    return value.get<std::string>();
}

inline Risk risk(const json& told) {
    if (!told.is_object()) throw Malformed{};
    Risk found{maybe(told, "target", 1.0), integer(told, "lifts"), integer(told, "slips"),
               integer(told, "outstanding"), maybe(told, "bound", REAL_MAX),
               integer(told, "warm_up_left")};
    // What older daemons leave out.
    if (told.contains("announced")) found.announced = integer(told, "announced");
    if (told.contains("awaited")) found.awaited = integer(told, "awaited");
    if (found.slips > found.lifts) throw Malformed{};
    return found;
}

// What daemons that know nothing of outcomes leave out.
inline void trust(const json& told, Verdict& found) {
    if (told.contains("p_slip_model")) found.p_slip_model = maybe(told, "p_slip_model", 1.0);
    if (found.p_slip_model && !found.p_slip) throw Malformed{};
    if (told.contains("outcomes")) found.outcomes = integer(told, "outcomes");
    const auto risked = told.find("risk");
    if (risked != told.end() && !risked->is_null()) found.risk = risk(*risked);
    const auto watched = told.find("supervised");
    if (watched == told.end()) return;
    if (!watched->is_boolean()) throw Malformed{};
    // Of an unknown grasp only if nothing but [risk] is against it.
    found.supervised = watched->get<bool>() &&
        std::all_of(found.reasons.begin(), found.reasons.end(), [](const std::string& reason) {
            return reason == "unproven" || reason == "low-confidence";
        });
}

// What a finger feels; none where that is not known.
inline std::optional<FingerState> finger_state(const json& told) {
    if (told.is_null()) return std::nullopt;
    const std::string word = text(told);
    for (const auto state : {FingerState::free, FingerState::touch, FingerState::slide})
        if (word == name(state)) return state;
    throw Malformed{};
}

// The fingers that feel it.
inline std::vector<std::string> feeling(const Verdict& said, FingerState state) {
    std::vector<std::string> found;
    for (const auto& [finger, felt] : said.fingers)
        if (felt == state) found.push_back(finger);
    return found;
}

// What daemons that know nothing of stillness leave out.
inline void stillness(const json& told, Verdict& found) {
    const auto early = told.find("early");
    if (early != told.end()) {
        if (!early->is_boolean()) throw Malformed{};
        found.early = early->get<bool>();
    }
    const auto owner = told.find("owner");
    if (owner != told.end() && !owner->is_null()) found.owner = text(*owner);
    if (told.contains("still_ms")) found.still_ms = maybe(told, "still_ms", REAL_MAX);
    const json nothing = json::object();
    const auto by_finger = [&](const char* which) -> const json& {
        const auto moves = told.find(which);
        if (moves == told.end() || moves->is_null()) return nothing;
        if (!moves->is_object()) throw Malformed{};
        return *moves;
    };
    const json &motion = by_finger("motion"), &limits = by_finger("motion_limits");
    const json& felt = by_finger("fingers");
    for (const auto& each : felt.items()) found.fingers[each.key()] = finger_state(each.value());
    for (const auto& each : motion.items())
        found.motion[each.key()] = maybe(motion, each.key(), REAL_MAX);
    for (const auto& each : limits.items())
        found.motion_limits[each.key()] = number(limits, each.key(), REAL_MAX);
}

inline Message message(const json& told) {
    Message all;
    Verdict& found = all.verdict;
    const auto code = integer(told, "verdict_code");
    if (code > 2 || text(field(told, "verdict")) != name(static_cast<Decision>(code)))
        throw Malformed{};
    found.decision = static_cast<Decision>(code);
    const bool known = found.decision != Decision::unknown;
    const json& valid = field(told, "valid");
    if (!valid.is_boolean() || valid.get<bool>() != known) throw Malformed{};
    found.p_slip = maybe(told, "p_slip", 1.0);
    if (found.p_slip.has_value() != known) throw Malformed{};
    const json& reasons = field(told, "reasons");
    if (!reasons.is_array() || reasons.empty() != known) throw Malformed{};
    for (const json& reason : reasons) found.reasons.push_back(text(reason));
    found.boot_id = text(field(told, "boot_id"));
    found.seq = integer(told, "seq");
    found.grasp = integer(told, "grasp");
    trust(told, found);
    stillness(told, found);
    all.read_ns = integer(told, "t_mono_ns");
    all.published_ns = all.read_ns + milliseconds(told, "age_ms");
    all.silence_ns = milliseconds(told, "silence_ms");
    return all;
}

// A JSON object without a key twice: readers differ in which of two values holds.
// Returns a value that is not an object for other text.
inline json parsed(std::string_view payload) {
    const auto opens = [](char c) { return c == '[' || c == '{'; };
    // A byte order mark is passed over by the parser, and a NUL is its end.
    if (payload.empty() || payload.front() == '\xEF' ||
        payload.find('\0') != std::string_view::npos || payload.size() > MESSAGE_MAX_BYTES ||
        std::count_if(payload.begin(), payload.end(), opens) > OPENINGS_MAX)
        return nullptr;
    std::vector<std::set<std::string>> keys;  // of the objects that are open
    bool twice = false;
    const auto note = [&](int, json::parse_event_t event, json& value) {
        if (event == json::parse_event_t::object_start) keys.emplace_back();
        if (event == json::parse_event_t::object_end) keys.pop_back();
        if (event == json::parse_event_t::key)
            twice |= !keys.back().insert(value.get<std::string>()).second;
        return true;
    };
    json told = json::parse(payload, note, false);
    return twice ? json() : told;
}

// A verdict message, or why it is none: `malformed` or `version`.
inline std::pair<std::optional<Message>, std::string> read(std::string_view payload,
                                                           double max_p_slip) {
    const json told = parsed(payload);
    if (!told.is_object()) return {std::nullopt, "malformed"};
    try {
        if (integer(told, "v") != VERSION) return {std::nullopt, "version"};
        Message found = message(told);
        Verdict& said = found.verdict;
        // What more likely slips is not stable.
        if (said.decision == Decision::stable && *said.p_slip >= max_p_slip)
            said = said.unknown({"p-slip"});
        return {std::move(found), ""};
    } catch (const Malformed&) {
        return {std::nullopt, "malformed"};
    }
}

// An outcome as it is sent. Throws `std::invalid_argument`.
inline std::string telling(const Verdict& lifted_on, Outcome how, const std::string& object_name) {
    if (lifted_on.boot_id.empty() || lifted_on.grasp.value_or(0) == 0)
        throw std::invalid_argument("nothing was lifted on a verdict that is of no grasp");
    const auto told = "outcome " + lifted_on.boot_id + ' ' + std::to_string(*lifted_on.grasp) +
                      (how == Outcome::held      ? " stable"
                       : how == Outcome::slipped ? " slip"
                                                 : " not-lifted");
    if (object_name.empty()) return told;
    const auto fits = [&object_name](const char& c) {
        const bool plain = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') ||
                           (c >= '0' && c <= '9') || c == '_';
        return plain || (&c != object_name.data() && (c == '-' || c == '.'));
    };
    if (object_name.size() > OBJECT_MAX || !std::all_of(object_name.begin(), object_name.end(), fits))
        throw std::invalid_argument("no name of an object: 1 to 64 ASCII letters, digits, _, -, ., the "
                                    "first no - and no .: " + object_name);
    return told + ' ' + object_name;
}

// The answer to an outcome; none if it is not understood.
inline std::optional<OutcomeAnswer> taken(std::string_view payload) {
    const json told = parsed(payload);
    if (!told.is_object()) return std::nullopt;
    try {
        if (integer(told, "v") != VERSION) return OutcomeAnswer{"version"};
        const json& ok = field(told, "ok");
        if (!ok.is_boolean()) return std::nullopt;
        const std::string why = ok.get<bool>() ? "" : text(field(told, "why"));
        if (why.empty() != ok.get<bool>()) return std::nullopt;
        return OutcomeAnswer{why};
    } catch (const Malformed&) {
        return std::nullopt;
    }
}

// The daemon's clock; none if the answer is not understood.
inline std::optional<Nanoseconds> told_clock(std::string_view payload) {
    const json told = parsed(payload);
    if (!told.is_object()) return std::nullopt;
    try {
        if (integer(told, "v") != VERSION) return std::nullopt;
        return integer(told, "t_mono_ns");
    } catch (const Malformed&) {
        return std::nullopt;
    }
}

// What the newest message says; no socket and no clock of its own.
class Newest {
public:
    Newest(std::string topic, Nanoseconds max_age_ns, bool same_computer, double max_p_slip = 0.5)
        : topic_(std::move(topic)), max_age_ns_(max_age_ns), same_computer_(same_computer),
          max_p_slip_(max_p_slip) {}

    // Words of each finger in the messages of the last look.
    std::set<std::pair<std::string, FingerState>> passed;
    Counts counts;
    bool may_be_announced = false;  // the lift that the last answer was about

    // For how long no message may come; 0 without one.
    Nanoseconds silence_ns() const { return message_ ? message_->silence_ns : 0; }

    // What came is not known any more, nor how the clocks differ; repeats stay repeats.
    void forget(std::string why) {
        message_.reset();
        best_.reset();
        bound_.reset();
        why_ = std::move(why);
    }

    // The daemon's clock read `told_ns` at some time after `asked_ns` (own clock).
    void compare_clocks(Nanoseconds asked_ns, Nanoseconds told_ns) {
        Nanoseconds least_ns = asked_ns - told_ns;
        if (bound_) least_ns = std::max(least_ns, at_least(*bound_, asked_ns));
        bound_ = {least_ns, asked_ns};
    }

    // Take in a message, which came after `empty_ns` and not after `now_ns` (own clock).
    // Whether it is a new one. A repeated one is not; one that is not understood is.
    bool take(const std::vector<std::string_view>& frames, Nanoseconds empty_ns,
              Nanoseconds now_ns) {
        if (frames.empty() || frames[0] != topic_) return false;
        auto [found, why] = frames.size() == 2
            ? read(frames[1], max_p_slip_) : std::pair(std::optional<Message>{}, std::string("malformed"));
        if (!found) {
            ++counts.malformed;
            message_.reset();
            why_ = why;
            return true;
        }
        if (!is_new(*found)) return false;
        ++counts.messages;
        published_ns_ = same_computer_ ? found->published_ns
                                       : by_arrival(found->published_ns, empty_ns, now_ns);
        for (const auto& [finger, felt] : found->verdict.fingers)
            if (felt) passed.emplace(finger, *felt);
        message_ = std::move(found);
        return true;
    }

    // What is known at a time (own clock).
    Verdict at(Nanoseconds now_ns) const {
        if (!message_) return Verdict{}.unknown({why_});
        const Nanoseconds age_ns = published_ns_ ? now_ns - *published_ns_ : 0;
        const Nanoseconds reading_age_ns = age_ns + message_->published_ns - message_->read_ns;
        Verdict said = message_->verdict;
        said.age_ms = static_cast<double>(reading_age_ns) / 1e6;
        const bool counts_on_it = said.decision != Decision::unknown || said.supervised;
        const bool may_have_crept = !bound_ && best_ && best_->first - least_ns_ > DRIFT_MAX_NS;
        const bool is_clock_known = age_ns >= -CLOCK_SLACK_NS && !may_have_crept;
        const bool is_fresh = age_ns <= message_->silence_ns && reading_age_ns <= max_age_ns_;
        // What a finger feels now is not known by what is old.
        if (!published_ns_ || !is_clock_known || !is_fresh)
            for (auto& [finger, felt] : said.fingers) felt.reset();
        if (!published_ns_) return said.unknown({"joining"});
        if (!is_clock_known) return said.unknown({"clock"});
        if (age_ns > message_->silence_ns) return said.unknown({"silent"});
        if (counts_on_it && reading_age_ns > max_age_ns_) return said.unknown({"stale"});
        return if_open(std::move(said));
    }

    // The outcome of a grasp was told: nothing of it is to be lifted again.
    void end(const Key& grasp) {
        ended_.erase(std::remove(ended_.begin(), ended_.end(), grasp), ended_.end());
        ended_.push_back(grasp);
        if (ended_.size() > LIFTS_MAX) ended_.pop_front();
    }

    // An answer; none if it is not understood.
    std::optional<Verdict> answered(std::string_view payload) {
        auto found = read(payload, max_p_slip_).first;
        may_be_announced = !found || found->verdict.decision == Decision::stable ||
                           found->verdict.reasons == std::vector<std::string>{"p-slip"};
        if (found) return if_open(found->verdict);
        ++counts.malformed;
        return std::nullopt;
    }

private:
    // A verdict, unknown if it is known of a grasp whose outcome was told.
    Verdict if_open(Verdict said) const {
        const bool is_offered = said.decision != Decision::unknown || said.supervised;
        const bool ended = std::find(ended_.begin(), ended_.end(), key(said)) != ended_.end();
        return is_offered && ended ? said.unknown({"outcome-told"}) : said;
    }

    bool is_former(const std::string& boot_id) const {
        return std::find(former_.begin(), former_.end(), boot_id) != former_.end();
    }

    // Whether it went out before what is known, of a start that so is not the newest.
    bool is_older(const Message& message) const {
        return same_computer_ && published_ns_ && message.published_ns < *published_ns_;
    }

    bool is_new(const Message& message) {
        const Verdict& found = message.verdict;
        if (boot_id_ != found.boot_id) {
            if (is_former(found.boot_id) || is_older(message)) return ++counts.former, false;
            if (boot_id_) {
                former_.push_back(*boot_id_);
                if (former_.size() > FORMER_MAX) former_.pop_front();
                ++counts.restarts;
                best_.reset();
                bound_.reset();
            }
            boot_id_ = found.boot_id;
            seq_ = *found.seq;
            return true;
        }
        if (*found.seq <= seq_) return ++counts.repeats, false;
        counts.lost += static_cast<std::uint64_t>(*found.seq - seq_ - 1);
        seq_ = *found.seq;
        return true;
    }

    // Least difference of the clocks at `now_ns`, ns: they may have drifted since `bound`.
    static Nanoseconds at_least(const std::pair<Nanoseconds, Nanoseconds>& bound,
                                Nanoseconds now_ns) {
        return bound.first - std::llrint(static_cast<double>(now_ns - bound.second) * DRIFT);
    }

    // When a message went out, by one's own clock: what it took longer than the fastest is age.
    // None for the first: it may have been kept for those who come late.
    std::optional<Nanoseconds> by_arrival(Nanoseconds published_ns, Nanoseconds empty_ns,
                                          Nanoseconds now_ns) {
        if (bound_)  // no earlier, however long it then waited to be read
            return std::min(published_ns + at_least(*bound_, now_ns), now_ns);
        const std::pair here{now_ns - published_ns, now_ns};
        if (!best_) {
            best_ = here;
            least_ns_ = here.first;
            return std::nullopt;
        }
        const auto [best_ns, at_ns] = *best_;
        const Nanoseconds late_ns =
            here.first - best_ns - std::llrint(static_cast<double>(now_ns - at_ns) * DRIFT);
        if (late_ns <= 0) {
            best_ = here;
            least_ns_ = std::min(least_ns_, here.first);
        }
        return std::min(empty_ns, now_ns - std::max<Nanoseconds>(late_ns, 0));
    }

    std::string topic_;
    Nanoseconds max_age_ns_;
    bool same_computer_;
    double max_p_slip_;
    std::optional<Message> message_;
    std::optional<Nanoseconds> published_ns_;  // of the message, by one's own clock, not later
    std::string why_ = "no-message";
    std::optional<std::string> boot_id_;
    std::int64_t seq_ = -1;
    std::deque<std::string> former_;
    std::deque<Key> ended_;  // grasps whose outcome was told, the oldest first
    std::optional<std::pair<Nanoseconds, Nanoseconds>> best_;  // of the clocks, and when
    Nanoseconds least_ns_ = 0;  // of these differences
    // What the clocks differ by at least, as the daemon told its own, and when.
    std::optional<std::pair<Nanoseconds, Nanoseconds>> bound_;
};

// What a call of ZeroMQ returns; a signal interrupts any of them before it has done anything.
template <typename Call>
auto uninterrupted(const Call& call) {
    while (true) {
        try {
            return call();
        } catch (const zmq::error_t& error) {
            if (error.num() != EINTR) throw;
        }
    }
}

// The next message, if one waits.
inline bool received(zmq::socket_t& socket, std::vector<zmq::message_t>& frames) {
    frames.clear();
    do {
        zmq::message_t frame;
        if (!uninterrupted([&] { return socket.recv(frame, zmq::recv_flags::dontwait); }))
            return false;
        frames.push_back(std::move(frame));
    } while (frames.back().more());
    return true;
}

// Something that is said to the daemon, on a socket of its own, until it has answered.
struct Call {
    zmq::socket_t socket;

    // The answer, if it is there; empty if it is none.
    std::optional<std::string> answer() {
        std::vector<zmq::message_t> frames;
        if (!socket || !received(socket, frames)) return std::nullopt;
        return frames.size() == 1 ? frames[0].to_string() : std::string();
    }

    // An answer that is late must not be mistaken for one to the next question.
    void hang_up() {
        socket.close();
        socket = zmq::socket_t();
    }
};

// The sockets.
class Link {
public:
    explicit Link(const Options& options)
        : options_(options), socket_(connected(zmq::socket_type::sub, options.endpoint)) {}

    bool receive(std::vector<zmq::message_t>& frames) { return received(socket_, frames); }

    // Waits for a message or an answer, up to the time given; a signal ends it sooner.
    void wait(std::int64_t timeout_ms) {
        std::vector<zmq_pollitem_t> items;
        for (zmq::socket_t* each : {&socket_, &asking.socket, &telling.socket})
            if (*each) items.push_back({each->handle(), 0, ZMQ_POLLIN, 0});
        zmq_poll(items.data(), static_cast<int>(items.size()), static_cast<long>(timeout_ms));
    }

    void ask(Call& call, const std::string& question) {
        if (!call.socket)
            call.socket = connected(zmq::socket_type::dealer, options_.ask_endpoint);
        uninterrupted(
            [&] { return call.socket.send(zmq::buffer(question), zmq::send_flags::dontwait); });
    }

    // Say that no lift follows what was asked, and hang up.
    void take_back(Call& call) {
        if (!call.socket) return;
        call.socket.set(zmq::sockopt::linger, TAKE_BACK_MS);
        call.socket.send(zmq::str_buffer("not-lifting"), zmq::send_flags::dontwait);
        leaving_.push_back(std::move(call.socket));
        call.hang_up();
        if (leaving_.size() <= LEAVING_MAX) return;
        leaving_.front().set(zmq::sockopt::linger, 0);
        leaving_.pop_front();
    }

    // Connect again, and forget what waits.
    void renew() {
        socket_.close();
        socket_ = connected(zmq::socket_type::sub, options_.endpoint);
    }

private:
    zmq::socket_t connected(zmq::socket_type kind, const std::string& endpoint) {
        auto made = uninterrupted([&] { return zmq::socket_t(context_, kind); });
        const auto set = [&made](auto option, const auto& value) {
            uninterrupted([&] { made.set(option, value); });
        };
        set(zmq::sockopt::linger, 0);
        set(zmq::sockopt::rcvhwm, QUEUE_MAX);
        set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(MESSAGE_MAX_BYTES));
        if (options_.keys) {
            set(zmq::sockopt::curve_serverkey, options_.keys->server_key);
            set(zmq::sockopt::curve_publickey, options_.keys->public_key);
            set(zmq::sockopt::curve_secretkey, options_.keys->secret_key);
        }
        if (endpoint.rfind("tcp://", 0) == 0) {
            set(zmq::sockopt::heartbeat_ivl, HEARTBEAT_MS);
            set(zmq::sockopt::heartbeat_timeout, HEARTBEAT_TIMEOUT_MS);
        }
        if (kind == zmq::socket_type::sub)
            set(zmq::sockopt::subscribe, "verdict." + options_.hand);
        else  // graspd knows the client by the name, and each connection by the number after it
            set(zmq::sockopt::routing_id, name_ + std::to_string(++calls_));
        uninterrupted([&] { made.connect(endpoint); });
        return made;
    }

    // 16 bytes that routing ids begin with: random, the first not zero.
    static std::string random_name() {
        std::random_device random;
        std::string name = "g";
        while (name.size() < NAME_BYTES) name += static_cast<char>(random() & 0xffU);
        return name;
    }

    Options options_;
    zmq::context_t context_;
    std::string name_ = random_name();
    std::uint64_t calls_ = 0;
    zmq::socket_t socket_;
    std::deque<zmq::socket_t> leaving_;  // whose last message is being sent

public:
    Call asking, telling, timing;  // closed before the context
};

// Deletes what it made, but not in a forked process: ZeroMQ's thread is the parent's alone.
struct Owner {
    pid_t pid = getpid();

    bool is_here() const { return getpid() == pid; }

    void operator()(Link* link) const {
        if (is_here()) delete link;
    }
};

// Whether the message that is the answer is still to come.
inline bool is_behind(const Verdict& newest, const Verdict& answer) {
    return newest.boot_id != answer.boot_id || !newest.seq || *newest.seq < *answer.seq;
}

// One question at a time, until the newest message confirms the answer that permits a lift.
class Question {
public:
    Question(Newest& newest, Link& link, bool asks, bool supervised,
             std::optional<double> still_ms)
        : newest_(newest), link_(link), asks_(asks), supervised_(supervised),
          still_ms_(still_ms) {}
    Question(const Question&) = delete;
    Question& operator=(const Question&) = delete;
    ~Question() {
        if (!asks_) return;
        try {
            if (!lifts_) link_.take_back(link_.asking);
        } catch (const zmq::error_t&) {  // it cannot be said; a person settles the lift
        }
        link_.asking.hang_up();
    }

    // Whether a verdict lets the hand lift.
    bool permits(const Verdict& said) const { return said || (supervised_ && said.supervised); }

    // Whether there is no need to wait.
    bool is_over(const Verdict& said) const {
        return said.decision == Decision::slip || permits(said);
    }

    // The newest message, if it confirms the answer; nothing to lift on otherwise. Asks.
    Verdict decided(Verdict newest) {
        newest = if_still(std::move(newest));
        if (!asks_) return newest;
        if (const auto payload = asked_ ? link_.asking.answer() : std::nullopt) {
            asked_ = false;
            heard_ = true;
            answer_ = newest_.answered(*payload);
            may_be_announced_ = newest_.may_be_announced;
            if (answer_) answer_ = if_still(*std::move(answer_));
            const bool permitted = answer_ && permits(*answer_);
            if (answer_ && answer_->decision == Decision::slip && !permitted) return *answer_;
            if (!permitted) answer_.reset();
        }
        if (answer_ && !is_behind(newest, *answer_)) {
            if (permits(newest) && newest.grasp == answer_->grasp &&
                newest.supervised == answer_->supervised) {
                newest.owner = answer_->owner;
                return newest;
            }
            answer_.reset();
        }
        if (!asked_ && !answer_) {
            if (may_be_announced_) link_.take_back(link_.asking);
            may_be_announced_ = false;
            link_.ask(link_.asking, "lift");
            asked_ = true;
        }
        if (newest.decision == Decision::unknown && !permits(newest)) return newest;
        return newest.unknown(newest.reasons.empty() ? std::vector<std::string>{"no-answer"}
                                                     : newest.reasons);
    }

    // What was decided; if it is not a lift on a message, also that no answer came.
    Verdict at_the_end(Verdict said) {
        lifts_ = permits(said);
        auto& why = said.reasons;
        if (asks_ && !heard_ && said.seq && !is_over(said) &&
            std::find(why.begin(), why.end(), "no-answer") == why.end())
            why.emplace_back("no-answer");
        return said;
    }

private:
    // A verdict, unknown if it permits a lift before the hand was still for long enough. A lift
    // under supervision must not be early; any lift needs `still_ms` of stillness.
    Verdict if_still(Verdict said) const {
        if (!permits(said)) return said;
        const bool still = !still_ms_ || (said.still_ms && *said.still_ms >= *still_ms_);
        return still && !(said.supervised && said.early) ? said : said.unknown({"not-still"});
    }

    Newest& newest_;
    Link& link_;
    bool asks_, supervised_, asked_ = false, heard_ = false;
    bool may_be_announced_ = false, lifts_ = false;
    std::optional<double> still_ms_;
    std::optional<Verdict> answer_;  // that is to be confirmed
};

}  // namespace detail

// Subscribes to the verdicts of one hand. Use it in one thread.
class Client {
public:
    // Throws `zmq::error_t` for an endpoint that is none, `std::invalid_argument` for an age or a
    // probability that is none.
    explicit Client(const Options& options)
        : newest_("verdict." + options.hand, age_ns(options.max_age_ms),
                  options.same_computer.value_or(detail::is_same_computer(options.endpoint)),
                  probability(options.max_p_slip)),
          link_(new detail::Link(options)), max_age_ns_(age_ns(options.max_age_ms)),
          asks_(!options.ask_endpoint.empty()),
          compares_clocks_(asks_ && !options.same_computer.value_or(
                                        detail::is_same_computer(options.endpoint))),
          warn_(options.warn) {}

    const Counts& counts() const { return newest_.counts; }

    // Lifts that were allowed before the last one, and of which graspd has no outcome. It cannot
    // learn from them, and they are in no bound of `risk`; `Options::warn` is told.
    std::int64_t unreported() const {
        std::int64_t found = forgotten_;
        for (const auto& [grasp, told] : lifts_) found += !told && grasp != last_;
        return found;
    }

    // The newest verdict; waits at most `wait_s` seconds for a new message.
    Verdict verdict(double wait_s = 0.0) {
        return next_verdict(detail::now_ns() + duration_ns(wait_s));
    }

    // Whether the current grasp is stable, known within `deadline_s` seconds from now.
    //
    // Waits for a fresh `stable`, or `slip`. With an ask endpoint the daemon is asked, and the
    // answer and the newest message of the same grasp must both say so; an unknown answer is asked
    // for again. Whatever else happens until the deadline is a no. Say `supervised` only while a
    // person watches: then what graspd wants to learn from (in the warm-up, and now and then after
    // it) may be lifted too if it is not `early`, and the answer says that it is such a lift. With
    // `still_ms` the hand must have been still for that time too, and a daemon that does not say
    // so gets a no; without it, what the daemon calls `stable` is enough, also where it is `early`:
    // its scene allows that. Throws `std::invalid_argument` for a time that is none.
    LiftAnswer may_i_lift(double deadline_s, bool supervised = false,
                          std::optional<double> still_ms = {}) {
        if (still_ms && !(*still_ms >= 0.0 && *still_ms <= REAL_MAX))
            throw std::invalid_argument("still_ms must be 0 or more, and finite");
        const Nanoseconds began_ns = detail::now_ns();
        const Nanoseconds due_ns = began_ns + duration_ns(deadline_s);
        detail::Question question(newest_, *link_, asks_ && is_here(), supervised, still_ms);
        Verdict decided = question.decided(verdict());
        while (!question.is_over(decided) && wait(due_ns)) {
            decided = question.decided(verdict());
            if (detail::now_ns() > due_ns && question.permits(decided))
                decided = decided.unknown({"late"});
        }
        decided = question.at_the_end(std::move(decided));
        const auto waited_ns = static_cast<double>(detail::now_ns() - began_ns);
        const LiftAnswer answer{decided, waited_ns / 1e9, supervised && decided.supervised};
        if (answer) allow(detail::key(decided));
        return answer;
    }

    // A time in the place of `supervised` would be mistaken for true.
    LiftAnswer may_i_lift(double deadline_s, double still_ms) = delete;

    // The verdict on the next grasp that is surely judged; none if there is none in time.
    //
    // Waits at most `deadline_s` seconds for a `stable` or a `slip` of a grasp that this method has
    // not returned before. With `supervised` it also returns what a person who watches may lift. It
    // never returns what is `early`. It asks nothing: before the lift, ask `may_i_lift`. Throws
    // `std::invalid_argument` for a time that is none.
    std::optional<Verdict> wait_for_grasp(double deadline_s, bool supervised = false) {
        const Nanoseconds due_ns = detail::now_ns() + duration_ns(deadline_s);
        do {
            const Verdict said = next_verdict(due_ns);
            const bool is_judged =
                said.decision != Decision::unknown || (supervised && said.supervised);
            if (is_judged && !said.early && detail::key(said) != returned_) {
                returned_ = detail::key(said);
                return said;
            }
        } while (is_here() && detail::now_ns() < due_ns);
        return std::nullopt;
    }

    // Watch over a lift: wait until something slides, at most `timeout_s` seconds.
    //
    // It ends at once when a finger says `slide`, when one that touched at first is `free`, and when
    // another grasp is at hand. It ends too when for `max_age_ms` no reading said that all that
    // touched at first still do: what is not known may slide. Throws `std::invalid_argument` for a
    // time that is none.
    SlideAnswer wait_for_slide(double timeout_s) {
        const Nanoseconds began_ns = detail::now_ns();
        const Nanoseconds due_ns = began_ns + duration_ns(timeout_s);
        Nanoseconds sure_ns = began_ns;
        std::vector<std::string> touched;
        Key grasp;
        bool is_first = true;  // what came before the first look was before the lift
        while (true) {
            const Verdict newest = verdict();
            const Nanoseconds now_ns = detail::now_ns();
            const auto touching = detail::feeling(newest, FingerState::touch);
            auto felt = is_first ? decltype(newest_.passed){} : newest_.passed;
            is_first = false;
            for (const auto& [finger, state] : newest.fingers)
                if (state) felt.emplace(finger, *state);
            std::vector<std::string> sliding;
            for (const auto& [finger, state] : felt)
                if (state == FingerState::slide) sliding.push_back(finger);
            if (touched.empty()) {
                touched = touching;
                grasp = detail::key(newest);
            }
            const auto is_free = [&](const std::string& finger) {
                return felt.count({finger, FingerState::free}) > 0;
            };
            const bool lost = std::any_of(touched.begin(), touched.end(), is_free) ||
                              (!touching.empty() && detail::key(newest) != grasp);
            if (!touched.empty() && std::includes(touching.begin(), touching.end(),
                                                  touched.begin(), touched.end()))
                sure_ns = now_ns - std::llrint(newest.age_ms.value_or(0.0) * 1e6);
            const bool is_old = now_ns - sure_ns > max_age_ns_;
            const bool ends = !sliding.empty() || lost || is_old || !is_here();
            if (ends || !wait(due_ns))
                return {newest, static_cast<double>(now_ns - began_ns) / 1e9, sliding,
                        !touched.empty() && !ends};
        }
    }

    // Tell how the lift ended that was made on a verdict, and what was lifted (empty: not told).
    // Tell `Outcome::not_lifted` if no lift followed a yes: else graspd waits for an outcome.
    //
    // Waits at most `wait_s` seconds: graspd answers once it is written to disk. An answer that
    // comes later is taken in by later calls; without one, tell it again. Throws
    // `std::invalid_argument` without an ask endpoint, for a verdict that is of no grasp, and for a
    // name that is not 1 to 64 letters (ASCII), digits, `_`, `-`, `.`, or begins with one of the
    // last two.
    OutcomeAnswer tell(const Verdict& lifted_on, Outcome how,
                       const std::string& object_name = {}, double wait_s = 2.0) {
        const std::string telling = detail::telling(lifted_on, how, object_name);
        if (!asks_) throw std::invalid_argument("an outcome needs an ask_endpoint");
        const Nanoseconds due_ns = detail::now_ns() + duration_ns(wait_s);
        if (!is_here()) return OutcomeAnswer{"other-process"};
        link_->telling.hang_up();
        link_->ask(link_->telling, telling);
        told_.reset();
        telling_ = detail::key(lifted_on);
        if (how != Outcome::not_lifted) newest_.end(telling_);
        drain();
        while (!told_ && wait(due_ns)) drain();
        return told_.value_or(OutcomeAnswer{"no-answer"});
    }

private:
    // Whether this is the process that made the client, and not a fork of it.
    bool is_here() const { return link_.get_deleter().is_here(); }

    // The newest verdict; waits for a new message until then at most.
    Verdict next_verdict(Nanoseconds due_ns) {
        if (!is_here()) return Verdict{}.unknown({"other-process"});
        while (!drain() && wait(due_ns)) {}
        if (behind_) return Verdict{}.unknown({"behind"});
        return newest_.at(detail::now_ns());
    }

    static Nanoseconds age_ns(double max_age_ms) {
        if (!(max_age_ms > 0.0)) throw std::invalid_argument("max_age_ms must be above 0");
        return duration_ns(max_age_ms / 1e3);
    }

    static double probability(double max_p_slip) {
        if (!(max_p_slip > 0.0 && max_p_slip <= 1.0))
            throw std::invalid_argument("max_p_slip must be above 0 and at most 1");
        return max_p_slip;
    }

    static Nanoseconds duration_ns(double seconds) {
        if (!(seconds >= 0.0 && seconds <= WAIT_MAX_S))
            throw std::invalid_argument("a time must be 0 s or more, and finite");
        return std::llrint(seconds * 1e9);
    }

    using Key = detail::Key;

    // The hand lifts this grasp; what was lifted before is over, and should have been told.
    void allow(const Key& lift) {
        last_ = lift;
        if (std::none_of(lifts_.begin(), lifts_.end(),
                         [&](const auto& each) { return each.first == lift; }))
            lifts_.emplace_back(lift, false);
        if (lifts_.size() > LIFTS_MAX) {
            forgotten_ += !lifts_.front().second;
            lifts_.pop_front();
        }
        if (unreported() < warn_at_) return;
        warn_at_ = unreported() + WARN_EVERY;
        if (warn_)
            warn_(std::to_string(unreported()) +
                  " lifts were allowed, and their outcome not told");
    }

    // Take in the answer to an outcome, if it is there.
    void hear() {
        const auto payload = link_->telling.answer();
        if (!payload) return;
        link_->telling.hang_up();
        told_ = detail::taken(*payload);
        newest_.counts.malformed += !told_;
        if (!told_) told_ = OutcomeAnswer{"malformed"};
        for (auto& [grasp, told] : lifts_) told = told || (*told_ && grasp == telling_);
    }

    // Ask another computer's daemon for its clock once a second, and take in the answer.
    void compare_clocks() {
        if (!compares_clocks_) return;
        const Nanoseconds now_ns = detail::now_ns();
        const auto payload = clock_asked_ns_ ? link_->timing.answer() : std::nullopt;
        if (payload) {
            const auto told_ns = detail::told_clock(*payload);
            if (told_ns) {
                newest_.compare_clocks(*clock_asked_ns_, *told_ns);
                clock_due_ns_ = *clock_asked_ns_ + CLOCK_EVERY_NS;
            }
            newest_.counts.malformed += !told_ns;
            clock_asked_ns_.reset();
        }
        if (now_ns < clock_due_ns_) return;
        // A late answer must not be mistaken for one to this question.
        if (clock_asked_ns_) link_->timing.hang_up();
        clock_asked_ns_ = now_ns;
        clock_due_ns_ = now_ns + CLOCK_RETRY_NS;
        link_->ask(link_->timing, "clock");
    }

    // Read all that waits, without waiting; whether there was anything new.
    bool drain() {
        bool anything_new = false;
        const Nanoseconds heard_ns = forget_what_is_old();
        hear();
        compare_clocks();
        behind_ = true;
        newest_.passed.clear();
        for (int taken = 0; behind_ && taken < QUEUE_MAX; ++taken) {
            const Nanoseconds before_ns = detail::now_ns();
            if (link_->receive(frames_)) {
                std::vector<std::string_view> views;
                for (const zmq::message_t& frame : frames_) views.push_back(frame.to_string_view());
                heard_ns_ = detail::now_ns();
                anything_new |= newest_.take(views, empty_ns_, heard_ns_);
            } else {
                empty_ns_ = before_ns;
                behind_ = false;
            }
        }
        read_ns_ = detail::now_ns();
        if (heard_ns_ != heard_ns) {
            quiet_ns_ = QUIET_NS;
        } else if (read_ns_ - heard_ns > std::max(quiet_ns_, newest_.silence_ns())) {
            quiet_ns_ = std::min(2 * quiet_ns_, QUIET_MAX_NS);
            connect_anew();
        }
        return anything_new;
    }

    // What came or waits since before a sleep of the computer, or a long time without a look; when
    // a message or a connection came last. While the computer sleeps the monotonic clock
    // stands still: all would look fresh.
    Nanoseconds forget_what_is_old() {
        const Nanoseconds slept_ns = detail::slept_ns();
        const bool slept = slept_ns - slept_ns_ > SLEPT_NS;
        slept_ns_ = std::max(slept_ns_, slept_ns);
        if (slept) newest_.forget("slept");
        if (slept || detail::now_ns() - read_ns_ > READ_WITHIN_NS) connect_anew();
        return heard_ns_;
    }

    void connect_anew() {
        link_->renew();
        link_->timing.hang_up();
        clock_asked_ns_.reset();
        clock_due_ns_ = 0;
        empty_ns_ = heard_ns_ = detail::now_ns();
    }

    // Wait for a message, but not for long; false when it is time to end.
    bool wait(Nanoseconds due_ns) {
        const Nanoseconds left_ns = due_ns - detail::now_ns();
        if (left_ns <= 0 || !is_here()) return false;
        link_->wait(std::min<std::int64_t>(left_ns / 1'000'000, SLICE_MS));
        return true;
    }

    detail::Newest newest_;
    std::unique_ptr<detail::Link, detail::Owner> link_;
    Nanoseconds max_age_ns_;
    bool asks_, compares_clocks_;
    std::optional<Nanoseconds> clock_asked_ns_;
    Nanoseconds clock_due_ns_ = 0;
    std::function<void(const std::string&)> warn_;
    std::deque<std::pair<Key, bool>> lifts_;  // that were allowed, and whether graspd has it
    Key last_, telling_;                      // of them, and that is being told
    Key returned_;                            // the grasp that `wait_for_grasp` returned last
    std::optional<OutcomeAnswer> told_;
    std::int64_t forgotten_ = 0, warn_at_ = 1;
    bool behind_ = false;
    Nanoseconds read_ns_ = detail::now_ns(), empty_ns_ = read_ns_, heard_ns_ = read_ns_;
    Nanoseconds quiet_ns_ = QUIET_NS, slept_ns_ = detail::slept_ns();
    std::vector<zmq::message_t> frames_;
};

}  // namespace graspd

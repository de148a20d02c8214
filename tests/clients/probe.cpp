// The C++ client's rules, line by line, for comparison with the Python client's.
//
// `new MAX_AGE_NS SAME_COMPUTER` begins again; `take EMPTY_NS NOW_NS FRAME...` (hex, `-` is empty)
// takes a message; `clock ASKED_NS TOLD_NS` compares clocks; `end BOOT_ID GRASP` tells an outcome;
// `at NOW_NS` answers with a line.
//
// `client ENDPOINT ASK_ENDPOINT MAX_AGE_MS` (`-`: not asked) makes one. Each of its calls answers
// with a line, after a line `warn TEXT` for each warning; one that throws with `refused TEXT`:
// `lift DEADLINE_S SUPERVISED STILL_MS` (`-`: none), `wait DEADLINE_S SUPERVISED`,
// `slide TIMEOUT_S`, `tell WAIT_S BOOT_ID GRASP OUTCOME NAME` (hex).
#include "graspd_client.hpp"

#include <iostream>
#include <sstream>
#include <type_traits>

namespace {

std::string unhexed(const std::string& text) {
    std::string bytes;
    for (std::size_t i = 0; i + 1 < text.size(); i += 2)
        bytes.push_back(static_cast<char>(std::stoi(text.substr(i, 2), nullptr, 16)));
    return bytes;
}

void say(const graspd::Verdict& verdict, const graspd::Counts& counts) {
    std::cout << graspd::name(verdict.decision) << ' ' << verdict.reasons.size();
    for (const std::string& reason : verdict.reasons) std::cout << ' ' << reason;
    std::cout << ' ' << verdict.grasp.value_or(-1) << ' ' << verdict.seq.value_or(-1) << ' '
              << (verdict.boot_id.empty() ? "-" : verdict.boot_id) << ' '
              << std::llrint(verdict.age_ms.value_or(-1) * 1e6) << ' '
              << std::llrint(verdict.p_slip.value_or(-1) * 1e9) << ' '
              << std::llrint(verdict.p_slip_model.value_or(-1) * 1e9) << ' ' << verdict.outcomes
              << ' ' << verdict.supervised << ' ' << static_cast<bool>(verdict) << ' ';
    if (const auto& risk = verdict.risk)
        std::cout << std::llrint(risk->target.value_or(-1) * 1e9) << ' ' << risk->lifts << ' '
                  << risk->slips << ' ' << risk->outstanding << ' '
                  << std::llrint(risk->bound.value_or(-1)) << ' ' << risk->warm_up_left << ' '
                  << risk->announced << ' ' << risk->awaited << ' ';
    std::cout << verdict.early << verdict.owner << ' ' << std::llrint(verdict.still_ms.value_or(-1) * 1e6) << ' ';
    for (const auto& [finger, moves] : verdict.motion)
        std::cout << finger << '=' << std::llrint(moves.value_or(-1) * 1e3) << ' ';
    for (const auto& [finger, limit] : verdict.motion_limits)
        std::cout << finger << '<' << std::llrint(limit * 1e3) << ' ';
    for (const auto& [finger, felt] : verdict.fingers)
        std::cout << finger << '-' << (felt ? graspd::name(*felt) : "unknown") << ' ';
    std::cout << counts.messages << ' '
              << counts.lost << ' ' << counts.repeats << ' ' << counts.malformed << ' '
              << counts.restarts << ' ' << counts.former << std::endl;
}

void call(std::optional<graspd::Client>& client, const std::string& order,
          std::istringstream& words) {
    const auto number = [&] {
        std::string word;
        words >> word;
        return word == "-" ? std::optional<double>{} : std::stod(word);
    };
    if (order == "client") {
        graspd::Options options;
        words >> options.endpoint >> options.ask_endpoint;
        if (options.ask_endpoint == "-") options.ask_endpoint.clear();
        options.max_age_ms = number().value();
        options.warn = [](const std::string& text) { std::cout << "warn " << text << std::endl; };
        client.emplace(options);
        return;
    }
    if (order == "lift") {
        const double deadline_s = number().value();
        const bool supervised = number().value() != 0.0;
        const auto answer = client.value().may_i_lift(deadline_s, supervised, number());
        const auto& said = answer.verdict;
        std::cout << static_cast<bool>(answer) << ' ' << answer.supervised << ' '
                  << graspd::name(said.decision) << ' ' << client->unreported() << ' '
                  << said.grasp.value_or(-1) << ' ' << (said.boot_id.empty() ? "-" : said.boot_id)
                  << ' ' << (said.owner.empty() ? "-" : said.owner);
        for (const std::string& reason : said.reasons) std::cout << ' ' << reason;
    } else if (order == "wait") {
        const double deadline_s = number().value();
        const auto found = client.value().wait_for_grasp(deadline_s, number().value() != 0.0);
        std::cout << (found ? found->grasp.value_or(0) : -1);
    } else if (order == "slide") {
        const auto slide = client.value().wait_for_slide(number().value());
        std::cout << static_cast<bool>(slide) << ' ' << slide.held;
        for (const std::string& finger : slide.sliding) std::cout << ' ' << finger;
    } else {
        graspd::Verdict lifted_on;
        std::string how, name;
        std::int64_t grasp = 0;
        const double wait_s = number().value();
        words >> lifted_on.boot_id >> grasp >> how >> name;
        lifted_on.grasp = grasp;
        const auto outcome = how == "stable" ? graspd::Outcome::held
                             : how == "slip" ? graspd::Outcome::slipped
                                             : graspd::Outcome::not_lifted;
        std::cout << client.value().tell(lifted_on, outcome, unhexed(name), wait_s).why;
    }
    std::cout << std::endl;
}

static_assert(std::is_move_constructible_v<graspd::Client>, "a client can be moved");

}  // namespace

int main() {
    graspd::detail::Newest newest("verdict.right", 0, true);
    std::optional<graspd::Client> client;
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::string order;
        words >> order;
        if (order == "new") {
            graspd::Nanoseconds max_age_ns = 0;
            bool same_computer = false;
            words >> max_age_ns >> same_computer;
            newest = graspd::detail::Newest("verdict.right", max_age_ns, same_computer);
        } else if (order == "take") {
            graspd::Nanoseconds empty_ns = 0, now_ns = 0;
            words >> empty_ns >> now_ns;
            std::vector<std::string> frames;
            for (std::string frame; words >> frame;) frames.push_back(unhexed(frame));
            newest.take({frames.begin(), frames.end()}, empty_ns, now_ns);
        } else if (order == "clock") {
            graspd::Nanoseconds asked_ns = 0, told_ns = 0;
            words >> asked_ns >> told_ns;
            newest.compare_clocks(asked_ns, told_ns);
        } else if (order == "end") {
            graspd::detail::Key grasp;
            words >> grasp.first >> grasp.second;
            newest.end(grasp);
        } else if (order == "at") {
            graspd::Nanoseconds now_ns = 0;
            words >> now_ns;
            say(newest.at(now_ns), newest.counts);
        } else {
            try {
                call(client, order, words);
            } catch (const std::exception& error) {
                std::cout << "refused " << error.what() << std::endl;
            }
        }
    }
}

// A consumer and writer in C#, .NET 8: dotnet run http://127.0.0.1:8080 mixer/recipe 7
// It prints every good value of the tag for five seconds, then writes a value, if there is one. The
// token of a writer is in GATEWAY_TOKEN. It ends with 1 unless the device acknowledged the write.
// It needs no package: the JSON API has the same documents as Zenoh (docs/page.md).
using System.Net.Http.Headers;
using System.Text;
using System.Text.Json;

using var client = new HttpClient { BaseAddress = new Uri(args[0]) };
client.Timeout = TimeSpan.FromSeconds(15);
if (Environment.GetEnvironmentVariable("GATEWAY_TOKEN") is { Length: > 0 } token)
    client.DefaultRequestHeaders.Authorization = new AuthenticationHeaderValue("Bearer", token);
var tag = Uri.EscapeDataString(args[1]);

async Task<string> Read()
{
    using var answer = JsonDocument.Parse(await client.GetStringAsync($"/api/tags?tags={tag}"));
    var tags = answer.RootElement.GetProperty("tags");
    if (tags.GetArrayLength() == 0) return "there is no such tag";
    var known = tags[0];
    if (known.GetProperty("quality").GetString() != "good") // it has no value to use
        return $"not good: {known.GetProperty("reason")}";
    var origin = known.TryGetProperty("origin", out var found) ? found.GetString() : null;
    var value = known.GetProperty("value").GetRawText();
    return origin is "simulated" or "replayed" ? $"not real: {value}" : value;
}

async Task<int> Write(string value)
{
    try
    {
        using var body = new StringContent(value, Encoding.UTF8, "application/json");
        using var answer = await client.PostAsync($"/api/write?tag={tag}", body);
        Console.WriteLine($"{(int)answer.StatusCode} {await answer.Content.ReadAsStringAsync()}");
        return answer.IsSuccessStatusCode ? 0 : 1; // 504: unclear, it may be done. Do not repeat.
    }
    catch (Exception error) when (error is HttpRequestException or TaskCanceledException)
    {
        Console.WriteLine("unclear: no answer, it may be done"); // read the value, do not repeat
        return 1;
    }
}

var last = "";
for (var until = DateTime.UtcNow.AddSeconds(5); DateTime.UtcNow < until; await Task.Delay(200))
{
    string now;
    try { now = await Read(); }
    catch (Exception error) when (error is HttpRequestException or TaskCanceledException)
    {
        now = $"not good: {error.Message}";
    }
    if (now != last) Console.WriteLine(last = now);
}
return args.Length > 2 ? await Write(args[2]) : 0;
